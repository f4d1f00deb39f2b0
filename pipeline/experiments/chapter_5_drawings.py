"""Drawings of chapter 5: what FPS picks, thresholds of the sigma filter, point counts, boxes from above, curves."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.experiments.chapter_5 import PRIMARY_METRIC
from pipeline.experiments.chapter_5_exact import CLEAN, NOISY, noise_label, noise_steps
from pipeline.experiments.chapter_5_figures import FPS_INPUTS, SHARES, THRESHOLDS, fps_label, sigma_view
from pipeline.experiments.example import read_example
from pipeline.experiments.intervals import Estimate, estimate

if TYPE_CHECKING:
    from pipeline.experiments.plan import TableResult

# Okabe and Ito's palette.
BLUE, ORANGE, GREEN, RED, PURPLE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7"
_FPS_VIEWS = {"all": "in the cloud", "fps_4096": "4096", "fps_1024": "1024", "fps_256": "256", "fps_64": "64"}


def draw_fps(result: TableResult, figure: Any) -> None:
    """Fig. 5.4: shares in the cloud and among the points of each level of furthest point sampling."""
    axes = figure.subplots(1, len(SHARES), sharey=False)
    for axis, column in zip(axes, SHARES):
        for preset, colour, marker in zip(FPS_INPUTS, (BLUE, RED, ORANGE, GREEN), "osD^"):
            outcomes = result.outcomes.get(fps_label(preset, "all"))
            if not outcomes:
                continue
            values = [outcomes[0].numbers.get(f"{view}/{column.key}", np.nan) for view in _FPS_VIEWS]
            axis.plot(range(len(values)), values, f"{marker}-", color=colour, label=FPS_INPUTS[preset])
        axis.set_xticks(range(len(_FPS_VIEWS)), list(_FPS_VIEWS.values()), rotation=40, ha="right", fontsize=8)
        axis.set_title(f"{column.title}, %", fontsize=10)
        axis.set_ylim(0, 1.06 * axis.dataLim.y1)
        axis.grid(alpha=0.3)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(FPS_INPUTS), fontsize=8)


def draw_sigma(result: TableResult, figure: Any) -> None:
    """Fig. 5.6 as numbers: what every pair of thresholds removes and loses; the thesis' pair is framed."""
    from matplotlib.patches import Rectangle

    lows, gaps = THRESHOLDS
    outcomes = next(iter(result.outcomes.values()))
    axes = figure.subplots(1, 2)
    for axis, key, title in zip(axes, ("removed", "lost"), ("points between surfaces removed", "clean points lost")):
        share = np.array([[outcomes[0].numbers[f"{sigma_view(low, gap)}/{key}"] for low in lows] for gap in gaps])
        image = axis.imshow(share, origin="lower", aspect="auto", cmap="cividis")
        for (i, j), value in np.ndenumerate(share):
            dark = value < (share.min() + share.max()) / 2
            axis.text(j, i, f"{value:.1f}", ha="center", va="center", fontsize=6, color="white" if dark else "black")
        axis.set_xticks(range(len(lows)), [f"{low:g}-{1 - low:g}" for low in lows], fontsize=7, rotation=30)
        axis.set_yticks(range(len(gaps)), [f"{gap:g}" for gap in gaps], fontsize=7)
        axis.set(title=f"{title}, %", xlabel="sigma dropped", ylabel="least gap of the surfaces, m")
        place = (lows.index(0.2) - 0.5, gaps.index(3.0) - 0.5)
        axis.add_patch(Rectangle(place, 1, 1, fill=False, color=RED, linewidth=2))
        figure.colorbar(image, ax=axis)


def draw_counts(result: TableResult, figure: Any) -> None:
    """Fig. 5.7: points after each step, ours and the thesis', and which they are."""
    rows = [row for row in result.table.rows if row.label in result.outcomes]
    left, right = figure.subplots(1, 2)
    places = np.arange(len(rows))
    numbers = [result.outcomes[row.label][0].numbers for row in rows]
    left.bar(places - 0.2, [one["points"] for one in numbers], 0.4, color=BLUE, label="ours")
    theirs = [row.printed[0] or np.nan if row.printed else np.nan for row in rows]
    left.bar(places + 0.2, theirs, 0.4, color=ORANGE, label="thesis")
    left.set(yscale="log", ylabel="points per frame")
    noise = np.array([one["all/noise"] for one in numbers])
    useful = np.array([one["all/object"] for one in numbers])
    right.bar(places, useful, 0.5, color=GREEN, label="on objects, no noise")
    right.bar(places, noise, 0.5, bottom=useful, color=RED, label="noise")
    right.bar(places, 100 - useful - noise, 0.5, bottom=useful + noise, color="#BBBBBB", label="background, no noise")
    right.set(ylabel="% of points", ylim=(0, 100))
    for axis in (left, right):
        names = [row.label.replace(", ", ",\n").replace(" and ", "\nand ") for row in rows]
        axis.set_xticks(places, names, fontsize=8)
        axis.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)


def draw_bev(result: TableResult, figure: Any) -> None:
    """Fig. 5.8: one frame; the image, then true and found boxes from above on each input."""
    from matplotlib.lines import Line2D

    rows = [row for row in result.table.rows if row.label in result.outcomes]
    grid = figure.add_gridspec(2, len(rows), height_ratios=(1, 2))
    for place, row in enumerate(rows):
        example = read_example(result.folders[row.label][0] / "example.npz")
        if place == 0:
            top = figure.add_subplot(grid[0, :])
            top.imshow(example.image)
            top.set(xticks=[], yticks=[])
        axis = figure.add_subplot(grid[1, place])
        for source, colour in ((1, "#56B4E9"), (0, "#333333")):
            part = example.points[example.points[:, 2] == source]
            axis.scatter(-part[:, 1], part[:, 0], s=0.25, color=colour, linewidths=0, rasterized=True)
        for boxes, colour, width in ((example.truth, GREEN, 2.2), (example.found, RED, 1.2)):
            for box in boxes:
                axis.plot(-box[[0, 1, 2, 3, 0], 1], box[[0, 1, 2, 3, 0], 0], color=colour, linewidth=width)
        axis.set(xlim=(-25, 25), ylim=(0, 60), aspect="equal", xlabel="m", title=row.label)
    lines = [("true box", GREEN, "-", ""), ("found box", RED, "-", "")]
    dots = [("measured point", "#333333", "", "o"), ("completed point", "#56B4E9", "", "o")]
    handles = [Line2D([], [], color=c, ls=ls, marker=m, ms=3, label=name) for name, c, ls, m in lines + dots]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8)


def draw_noise(result: TableResult, figure: Any) -> None:
    """AP over the strength of each kind of noise, for detectors trained on clean and on equally noisy clouds."""
    axes = figure.subplots(1, 2, sharey=True)
    column = result.table.column(PRIMARY_METRIC)

    def value(label: str) -> Estimate | None:
        return estimate(result.outcomes.get(label, []), result.table.row(label), column)

    for axis, kind in zip(axes, ("blur", "misalignment")):
        steps = [strength for name, strength, _ in noise_steps() if name == kind]
        for regime, colour, marker, aside in ((CLEAN, BLUE, "o", -0.05), (NOISY, ORANGE, "s", 0.05)):
            found = [value("noise-free"), *(value(noise_label(kind, strength, regime)) for strength in steps)]
            done = [(place + aside, one) for place, one in enumerate(found) if one is not None]
            axis.plot([p for p, _ in done], [one.mean for _, one in done], f"{marker}-", color=colour, label=regime)
            for place, one in done:
                axis.plot([place] * 2, [one.low, one.high], color=colour, linewidth=1.5)
        axis.set_xticks(range(len(steps) + 1), ["none", *steps], rotation=20, fontsize=8)
        axis.set(title=kind, ylim=(0, None))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel(column.heading)
    axes[0].legend(fontsize=8)


DRAWINGS: dict[str, Callable[[TableResult, Any], None]] = {
    "fps": draw_fps,
    "sigma": draw_sigma,
    "counts": draw_counts,
    "bev": draw_bev,
    "noise": draw_noise,
}
# Width and height in inches.
SIZES: dict[str, tuple[float, float]] = {
    "fps": (12.0, 4.2),
    "sigma": (11.0, 4.6),
    "counts": (10.0, 4.0),
    "bev": (12.0, 7.5),
    "noise": (9.0, 4.2),
}
