"""Draws the figures of docs/method.md from a synthetic frame with the classical completion: no weights, about 20 s.

Command:  python docs/images/make_method.py
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from completion.figures import plot_expected_losses
from completion.infer import load_completer
from completion.types import CompletedDepth
from detection.boxes import corners
from detection.kitti_format import KittiObject, boxes_of
from pipeline.geometry.project import project_points
from pipeline.pointcloud.augment import AugmentedCloud, augment_frame
from pipeline.pointcloud.presets import PRESETS
from pipeline.pointcloud.pseudo_sigma import pseudo_sigma
from pipeline.pointcloud.sigma_filter import SigmaBand, sigma_filter
from pipeline.simulation.synth import SyntheticFrame, SynthSettings, simulate_frame

OUT = Path(__file__).resolve().parent
# Okabe and Ito's colours, told apart by colour-blind readers too.
TRUTH, MEASURED, COMPLETED, DROPPED = "#9aa0a6", "#0072B2", "#E69F00", "#D55E00"
FRAME = SynthSettings(seed=40)
INDEX = 0
REACH = 4.0  # metres around the car


@dataclass(frozen=True)
class Example:
    """A frame, its completed depth with surfaces, and the car the figures look at."""

    frame: SyntheticFrame
    completed: CompletedDepth
    car: KittiObject

    @property
    def keep(self) -> NDArray[np.bool_]:
        return sigma_filter(self.completed, SigmaBand())


def example() -> Example:
    frame = simulate_frame(FRAME, INDEX)
    sparse = project_points(frame.points, frame.calibration, frame.depth.shape)
    completed = pseudo_sigma(load_completer("classical").complete(sparse, frame.image).depth)
    cars = [item for item in frame.labels if item.type == "Car" and item.occluded == 0 and item.truncated < 0.05]
    return Example(frame, completed, min(cars, key=lambda item: abs(item.location[2] - 11)))


def figure(width: float, height: float) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    made = Figure(figsize=(width, height), layout="constrained", dpi=130)
    FigureCanvasAgg(made)
    return made


def draw_surfaces(shown: Example) -> None:
    """The image around a car, and depth along one image row through it."""
    left, top, right, bottom = shown.car.bbox
    row, reach = round(0.6 * top + 0.4 * bottom), round(0.45 * (right - left))
    columns = np.arange(max(0, round(left) - reach), min(shown.frame.depth.shape[1], round(right) + reach))
    made = figure(9, 5.6)
    upper, lower = made.subplots(2, 1, height_ratios=(1, 1.35))
    rows = slice(max(0, round(top) - 25), round(bottom) + 15)
    upper.imshow(
        shown.frame.image[rows, columns[0] : columns[-1] + 1],
        extent=(columns[0], columns[-1] + 1, rows.stop, rows.start),
        aspect="auto",
    )
    upper.axhline(row, color=DROPPED, lw=1.5)
    upper.set(title="the row looked at", yticks=[], xticks=[])
    truth, depth = shown.frame.depth[row, columns], shown.completed.depth[row, columns]
    kept = shown.keep[row, columns]
    lower.plot(columns, np.where(truth > 0, truth, np.nan), ".", color=TRUTH, ms=7, label="exact surfaces")
    lower.plot(columns[kept], depth[kept], ".", color=COMPLETED, ms=4, label="completed, kept")
    lower.plot(columns[~kept], depth[~kept], "x", color=DROPPED, ms=5, label="between two surfaces, dropped")
    highest = min(80.0, 1.1 * float(max(depth.max(), truth.max())))
    lower.set(xlabel="image column", ylabel="depth [m]", ylim=(0, highest), xlim=(columns[0], columns[-1]))
    lower.legend(loc="upper center", ncols=3, frameon=False, bbox_to_anchor=(0.5, 1.14))
    made.savefig(OUT / "method_surfaces.png")


def draw_clouds(shown: Example) -> None:
    """The same car from above: measured, completed, filtered, augmented."""
    made = figure(10, 3.6)
    panels = made.subplots(1, 4, sharey=True)
    titles = {
        "L": "L: measured",
        "D": "D: completed",
        "D_F": "D_F: smeared pixels dropped",
        "L_D_F": "L_D_F: augmented",
    }
    x0, _, z0 = shown.car.location
    for panel, (name, title) in zip(panels, titles.items()):
        frame = shown.frame
        cloud = augment_frame(shown.completed, frame.points, frame.calibration, PRESETS[name], seed=0)
        around = near_car(cloud, shown)
        for source, colour in ((1, COMPLETED), (0, MEASURED)):
            x, z = around[around[:, 4] == source, 0], around[around[:, 4] == source, 2]
            panel.plot(x, z, ".", ms=1.2 if source else 2.4, color=colour, rasterized=True)
        outline = corners(boxes_of([shown.car]))[0][[0, 1, 2, 3, 0]]
        panel.plot(outline[:, 0], outline[:, 2], color="black", lw=1.2)
        panel.set_title(f"{title}\n{len(around):,} points", fontsize=9)
        panel.set(aspect="equal", xlabel="right [m]", xlim=(x0 - REACH, x0 + REACH), ylim=(z0 - REACH, z0 + REACH))
    panels[0].set_ylabel("forward [m]")
    made.savefig(OUT / "method_clouds.png")


def near_car(cloud: AugmentedCloud, shown: Example) -> NDArray[np.float64]:
    """(N, 5) rows of a cloud within REACH metres of the car and above its ground, x y z in the camera frame."""
    calibration = shown.frame.calibration
    camera = calibration.velo_to_cam(cloud.points[:, :3])
    x, y, z = shown.car.location
    inside = (np.abs(camera[:, 0] - x) < REACH) & (np.abs(camera[:, 2] - z) < REACH) & (camera[:, 1] < y - 0.25)
    return np.concatenate((camera[inside], cloud.points[inside, 3:5]), 1)


if __name__ == "__main__":
    chosen = example()
    draw_surfaces(chosen)
    draw_clouds(chosen)
    plot_expected_losses(OUT / "method_losses.png")
