"""The figures and the worked example of docs/evaluation.md.

python -m benchmarks.ap_figures docs/images                 # draw the figures
python -m benchmarks.ap_figures --example runs/example      # write the worked example as label_2/ and detections/
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

from detection.boxes import corners
from detection.evaluation.curves import average_precision
from detection.evaluation.kitti_ap import prepare
from detection.kitti_format import KittiObject, boxes_of, format_line

GREEN, RED, GREY, BLUE, ORANGE = "#2a7f3f", "#c0392b", "#8a8a8a", "#1f5fa8", "#d98200"
Frames = list[list[KittiObject]]


def box(cls: str, x: float, shift: float = 0.0, score: float | None = None, occluded: int = 0) -> KittiObject:
    """A car 4 m long, 2 m wide, 1.5 m high that faces +x, 20 m ahead; moved by `shift` metres along its length."""
    left = 600 + 36 * x
    return KittiObject(
        type=cls,
        truncated=0.0 if score is None else -1,
        occluded=occluded if score is None else -1,
        alpha=0.0,
        bbox=(left - 72 + 36 * shift, 170.0, left + 72 + 36 * shift, 224.0),
        size=(1.5, 2.0, 4.0),
        location=(x + shift, 1.6, 20.0),
        ry=0.0,
        score=score,
    )


def worked_example() -> tuple[Frames, Frames]:
    """Three frames: four cars that count, a van, an occluded car, a DontCare area, and seven detections of cars."""
    area = KittiObject("DontCare", -1, -1, -10, (850, 160, 1100, 240), (-1, -1, -1), (-1000, -1000, -1000), -10)
    labels = [
        [box("Car", -6), box("Car", 0), box("Van", 6)],
        [box("Car", 0)],
        [box("Car", -6), box("Car", 0, occluded=3), area],
    ]
    detections = [
        [box("Car", -6, score=0.95), box("Car", 6, score=0.90)],
        [box("Car", 0, 0.6, score=0.85), box("Car", 0, 0.2, score=0.70)],
        [box("Car", -6, 1.0, score=0.88), box("Car", 0, score=0.60), box("Car", 10, score=0.50)],
    ]
    return labels, detections


def write_example(folder: Path) -> None:
    """The worked example as two folders of KITTI files."""
    for name, frames in zip(("label_2", "detections"), worked_example()):
        (folder / name).mkdir(parents=True, exist_ok=True)
        for index, items in enumerate(frames):
            text = "".join(format_line(item) + "\n" for item in items)
            (folder / name / f"{index:06d}.txt").write_text(text)


def new_figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def outline(axes: Axes, item: KittiObject, **style: object) -> None:
    """The rectangle of a box seen from above."""
    face = corners(boxes_of([item]))[0, :4]
    axes.add_patch(Polygon(face[:, [0, 2]], closed=True, **style))


def draw_example_frames(path: Path) -> None:
    """The worked example seen from above, each object with its fate in 3D."""
    labels, detections = worked_example()
    figure = new_figure(10.4, 2.75)
    notes = [
        [(-6, "A\nfound"), (0, "B\nmissed"), (6, "V (van)\nignored")],
        [(0, "C\nfound")],
        [(-6, "D\nmissed"), (0, "E, occluded 3\nignored")],
    ]
    fates = [
        [("0.95", GREEN), ("0.90", GREY)],
        [("0.85", GREEN), ("0.70", GREEN)],
        [("0.88", RED), ("0.60", GREY), ("0.50", RED)],
    ]
    grid = figure.add_gridspec(1, 3, width_ratios=(18, 7, 22))
    for frame in range(3):
        axes = figure.add_subplot(grid[0, frame])
        for item in labels[frame]:
            if item.type != "DontCare":
                outline(axes, item, facecolor="#dfe8f3", edgecolor=BLUE, linewidth=1.6)
        for x, text in notes[frame]:
            axes.text(x, 17.9, text, ha="center", va="top", fontsize=9, color=BLUE)
        for place, (item, (score, colour)) in enumerate(zip(detections[frame], fates[frame])):
            outline(axes, item, facecolor="none", edgecolor=colour, linewidth=1.6, linestyle="--")
            height = 21.5 + (1.0 if frame == 1 and place == 0 else 0)
            axes.text(item.location[0], height, score, ha="center", va="center", fontsize=10, color=colour)
        if frame == 2:
            axes.text(10, 17.9, "DontCare\nin the image", ha="center", va="top", fontsize=9, color=GREY)
        axes.set(xlim=[(-9, 9), (-3.5, 3.5), (-9, 13)][frame], ylim=(15.6, 23.4), aspect="equal", xticks=[], yticks=[])
        axes.set_title(f"frame {frame:06d}", fontsize=10)
    figure.suptitle(
        "Worked example from above (Car, 3D, IoU > 0.7): labels blue, detections dashed with their score;\n"
        "green finds a label, red is a false positive, grey counts neither way",
        fontsize=10,
    )
    figure.savefig(path, dpi=120)


def draw_example_curve(path: Path) -> None:
    """Precision over recall of the worked example, written once and twenty times."""
    labels, detections = worked_example()
    figure = new_figure(9.6, 3.6)
    for place, copies in enumerate((1, 20), start=1):
        evaluation = prepare(labels * copies, detections * copies, classes=["Car"], metrics=["3d"], iou_set="strict")
        curve = evaluation.curves(evaluation.targets[0])[1]
        samples = curve.precision()
        axes = figure.add_subplot(1, 2, place)
        axes.bar(np.arange(41) / 40, samples, 0.016, color=BLUE, label="interpolated precision")
        used = len(curve.thresholds)
        axes.plot(np.arange(used) / 40, curve.raw_precision, "o", color=ORANGE, markersize=4, label="at a threshold")
        axes.set(xlim=(-0.02, 1.02), ylim=(0, 1.08), xlabel="sample k / 40 (recall)", ylabel="precision")
        axes.set_title(
            f"{curve.n_labels} cars count, {used} thresholds: "
            f"R40 {average_precision(samples, 40):.2f}, R11 {average_precision(samples, 11):.2f}",
            fontsize=10,
        )
        axes.grid(alpha=0.3)
        axes.legend(loc="upper right", fontsize=9)
    figure.savefig(path, dpi=120)


def draw_overlaps(path: Path) -> None:
    """The three overlaps of one pair of boxes."""
    figure = new_figure(10.2, 3.2)
    image, ground, side = (figure.add_subplot(1, 3, place) for place in (1, 2, 3))
    for x, y, colour in ((2.0, 2.0, BLUE), (3.2, 2.6, ORANGE)):
        image.add_patch(Rectangle((x, y), 6, 4, facecolor=colour, alpha=0.25))
        image.add_patch(Rectangle((x, y), 6, 4, fill=False, edgecolor=colour, linewidth=1.8))
    image.text(5.6, 4.3, "intersection", ha="center", fontsize=9)
    image.set(xlim=(0, 11), ylim=(8.6, 0), title="2D: boxes in the image")
    label = KittiObject("Car", 0, 0, 0, (0, 0, 1, 1), (1.5, 1.7, 4.0), (0, 1.6, 0), 0.25)
    found = KittiObject("Car", 0, 0, 0, (0, 0, 1, 1), (1.7, 1.8, 4.2), (0.6, 1.5, 0.35), 0.55)
    for item, colour in ((label, BLUE), (found, ORANGE)):
        outline(ground, item, facecolor=colour, alpha=0.25)
        outline(ground, item, fill=False, edgecolor=colour, linewidth=1.8)
    ground.set(xlim=(-3.2, 3.8), ylim=(-2.4, 2.8), aspect="equal", title="BEV: turned rectangles on the ground")
    ground.set(xlabel="x right (m)", ylabel="z forward (m)")
    for item, left, colour in ((label, 0.0, BLUE), (found, 0.6, ORANGE)):
        y, h = item.location[1], item.size[0]
        side.add_patch(Rectangle((left, y - h), 3.0, h, facecolor=colour, alpha=0.25))
        side.add_patch(Rectangle((left, y - h), 3.0, h, fill=False, edgecolor=colour, linewidth=1.8))
        side.plot(left + 1.5, y, "o", color=colour)
    top, bottom = max(1.6 - 1.5, 1.5 - 1.7), min(1.6, 1.5)
    side.annotate("", (4.0, top), (4.0, bottom), arrowprops={"arrowstyle": "<->", "color": "black"})
    side.text(4.1, (top + bottom) / 2, "shared\nheight", va="center", fontsize=9)
    side.set(xlim=(-0.6, 5.4), ylim=(2.2, -0.8), title="3D: shared ground x shared height", ylabel="y down (m)")
    side.text(2.0, 2.0, "dots: location, the bottom centre", ha="center", fontsize=9)
    for axes in (image, ground, side):
        axes.title.set_fontsize(10)
    for axes in (image, side):
        axes.set_xticks([])
    image.set_yticks([])
    figure.savefig(path, dpi=120)


def draw_passes(path: Path) -> None:
    """Frame 000001 of the worked example: the same label goes to different detections."""
    labels, detections = worked_example()
    (label,), (first, second) = labels[1], detections[1]
    figure = new_figure(9.8, 3.4)
    cases = [
        ("pass A: highest score wins\nthe true positive's score is 0.85", {0: GREEN, 1: GREY}, "no counting here"),
        ("pass B, threshold 0.85\nonly one detection is admitted", {0: GREEN}, "tp 1, fp 0"),
        ("pass B, threshold 0.70\nlargest IoU wins", {0: RED, 1: GREEN}, "tp 1, fp 1"),
    ]
    for place, (title, colours, outcome) in enumerate(cases, start=1):
        axes = figure.add_subplot(1, 3, place)
        outline(axes, label, facecolor="#dfe8f3", edgecolor=BLUE, linewidth=1.6)
        for index, item in enumerate((first, second)):
            if index in colours:
                outline(axes, item, fill=False, edgecolor=colours[index], linewidth=2, linestyle="--")
        for index, (text, side) in enumerate((("score 0.85, IoU 0.74", 21.6), ("score 0.70, IoU 0.90", 18.4))):
            axes.text(0.2, side, text, ha="center", va="center", fontsize=9, color=colours.get(index, "#d0d0d0"))
        axes.text(0.2, 17.5, outcome, ha="center", va="center", fontsize=10)
        axes.set(xlim=(-3.2, 3.6), ylim=(16.9, 22.3), aspect="equal", xticks=[], yticks=[])
        axes.set_title(title, fontsize=9)
    figure.suptitle("Frame 000001: one label (blue), two detections that both overlap it by more than 0.7", fontsize=10)
    figure.savefig(path, dpi=120)


def draw_small_sets(path: Path) -> None:
    """What a perfect detector scores with n objects, and where the 41 thresholds fall."""
    figure = new_figure(9.6, 3.5)
    cap, samples = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2)
    counts = np.arange(1, 61)
    for points, colour in ((40, BLUE), (11, ORANGE)):
        values = []
        for n in counts:
            frames = [[box("Car", 0)] for _ in range(n)]
            found = [[box("Car", 0, score=1 - i / 1000)] for i in range(n)]
            evaluation = prepare(frames, found, classes=["Car"], metrics=["3d"], iou_set="strict", recall=points)
            values.append(evaluation.average_precision(evaluation.targets[0])[0])
        cap.plot(counts, values, ".", color=colour, label=f"R{points}")
    cap.axvline(41, color=GREY, linestyle=":")
    cap.text(42, 8, "41 objects", color=GREY, fontsize=9)
    cap.set(xlabel="objects that count", ylabel="AP of a perfect detector", ylim=(-3, 105))
    cap.grid(alpha=0.3)
    cap.legend()
    for row, (n, hits) in enumerate(((10, 10), (40, 40), (100, 80), (400, 320))):
        frames = [[box("Car", 0)] for _ in range(n)]
        found = [[box("Car", 0, score=1 - i / 1000)] if i < hits else [] for i in range(n)]
        evaluation = prepare(frames, found, classes=["Car"], metrics=["3d"], iou_set="strict")
        curve = evaluation.curves(evaluation.targets[0])[0]
        samples.plot(curve.recall, np.full(len(curve.recall), row), "|", color=BLUE, markersize=12)
        samples.text(1.04, row, f"{len(curve.recall)} thresholds", va="center", fontsize=9)
    samples.set_yticks(range(4), ["10 of 10\nfound", "40 of 40", "80 of 100", "320 of 400"])
    samples.set(xlim=(0, 1.42), ylim=(-0.6, 3.6), xlabel="recall at the thresholds")
    samples.set_xticks(np.arange(0, 1.01, 0.25))
    figure.savefig(path, dpi=120)


FIGURES = {
    "evaluation_example_frames.png": draw_example_frames,
    "evaluation_example_curve.png": draw_example_curve,
    "evaluation_overlaps.png": draw_overlaps,
    "evaluation_passes.png": draw_passes,
    "evaluation_small_sets.png": draw_small_sets,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, help="where the figures go")
    parser.add_argument("--example", type=Path, metavar="DIR", help="write the worked example as KITTI files")
    arguments = parser.parse_args()
    if arguments.example:
        write_example(arguments.example)
    if arguments.folder:
        arguments.folder.mkdir(parents=True, exist_ok=True)
        for name, draw in FIGURES.items():
            draw(arguments.folder / name)


if __name__ == "__main__":
    main()
