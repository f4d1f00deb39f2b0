"""What each point-cloud step does to the three kinds of depth noise, on scenes whose truth is known.

    python -m pipeline.experiments.cloud_study --data ROOT --completed TWISE=runs/a --completed L2=runs/b --out OUT

The data set is in KITTI's object layout with dense truth (training/depth_2) and semantics (training/semantic_2), as
`--stage synth` writes it; a completion is a run folder (depth/, twin/) or a folder of uint16 PNGs. Written are
cloud_study.json, cloud_study.md and, per completion, the sigma sweep of Fig. 5.6a as sigma_sweep_NAME.png.

Recall of object points is counted in cells: of the 0.2 m cells in which the completion has a clean object point, the
share that still has one after the step. Grid sampling therefore costs no recall by itself.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from completion.types import CompletedDepth
from pipeline.base.paths import RunFolder
from pipeline.data.depth_folder import read_depth_folder
from pipeline.geometry.back_project import back_project
from pipeline.geometry.calibration import Calibration
from pipeline.geometry.clouds import DenseCloud
from pipeline.pointcloud.grid_sampling import grid_sampling
from pipeline.pointcloud.presets import AugmentSettings
from pipeline.pointcloud.pseudo_sigma import pseudo_sigma
from pipeline.pointcloud.radius_gather import radius_gather
from pipeline.pointcloud.semantic_mask import object_score, semantic_mask
from pipeline.pointcloud.sigma_filter import sigma_filter
from pipeline.pointcloud.taxonomy import CLEAN, LABELS, NOISE_INBET, UNKNOWN, Taxonomy, label_noise
from pipeline.run_folder.frame_outputs import FrameOutputs

LOWS = (0.01, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)
GAPS = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)


@dataclass(frozen=True)
class StudyFrame:
    """One frame with its truth: maps (H, W), raw points (N, 4) in the LiDAR frame."""

    completed: CompletedDepth
    truth: NDArray[np.float32]
    semantics: NDArray[np.uint8]
    points: NDArray[np.float32]
    calibration: Calibration


@dataclass
class StepTally:
    """Sums over frames after one step: points per label, cells with a clean object point."""

    labels: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(LABELS), np.int64))
    object_cells: int = 0

    def row(self, first: StepTally) -> dict[str, float]:
        """Points, share of clean points, recall, and per kind of noise what is left of the first step's, in percent."""
        known = int(self.labels.sum() - self.labels[UNKNOWN])
        left = {
            f"{name} left %": 100 * float(self.labels[i]) / max(int(first.labels[i]), 1)
            for i, name in enumerate(LABELS)
            if i > CLEAN
        }
        return {
            "points": int(self.labels.sum()),
            **{name: int(self.labels[i]) for i, name in enumerate(LABELS) if i != UNKNOWN},
            "precision %": 100 * float(self.labels[CLEAN]) / max(known, 1),
            "object recall %": 100 * self.object_cells / max(first.object_cells, 1),
            **left,
        }


@dataclass
class SigmaSweep:
    """Share of points inside the band for every (low, gap), high = 1 - low: counts over frames, (LOWS, GAPS)."""

    between: NDArray[np.int64] = field(default_factory=lambda: np.zeros((len(LOWS), len(GAPS)), np.int64))
    clean: NDArray[np.int64] = field(default_factory=lambda: np.zeros((len(LOWS), len(GAPS)), np.int64))
    totals: NDArray[np.int64] = field(default_factory=lambda: np.zeros(2, np.int64))
    density: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 50, 50)))

    def add(self, completed: CompletedDepth, labels: NDArray[np.uint8]) -> None:
        """Count one frame."""
        if completed.sigma is None or completed.background is None or completed.foreground is None:
            return
        gap = completed.background - completed.foreground
        for kind, (label, counts) in enumerate(((NOISE_INBET, self.between), (CLEAN, self.clean))):
            chosen = labels == label
            sigma, gaps = completed.sigma[chosen], gap[chosen]
            self.totals[kind] += len(sigma)
            self.density[kind] += np.histogram2d(sigma, gaps, bins=50, range=((0, 1), (0, 12)))[0]
            for i, low in enumerate(LOWS):
                inside = gaps[(sigma > np.float32(low)) & (sigma < np.float32(1 - low))]
                counts[i] += [int(np.count_nonzero(inside >= np.float32(least))) for least in GAPS]

    def shares(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Percent of noise-inbet removed and percent of clean points lost, both (LOWS, GAPS)."""
        return 100 * self.between / max(self.totals[0], 1), 100 * self.clean / max(self.totals[1], 1)


def steps_of_frame(frame: StudyFrame, settings: AugmentSettings) -> list[tuple[str, DenseCloud]]:
    """The cloud after each step of thesis 5.3.4 in turn."""
    completed, calibration = frame.completed, frame.calibration
    cloud = back_project(completed.depth, calibration, completed.depth > 0)
    steps = [("completed depth", cloud)]
    if settings.sigma is not None:
        cloud = cloud.select(cloud.look_up(sigma_filter(completed, settings.sigma)))
        steps.append(("+ sigma filter", cloud))
    if settings.grid is not None:
        cloud = grid_sampling(cloud, settings.grid)
        steps.append(("+ grid sampling", cloud))
    if settings.near_lidar is not None:
        near = radius_gather(cloud.points, cloud.look_up(completed.depth), frame.points, settings.near_lidar)
        steps.append(("+ near raw LiDAR (no mask)", cloud.select(near)))
    if settings.semantic is not None:
        score = object_score(frame.semantics, settings.classes)
        relevant = cloud.look_up(semantic_mask(score, settings.semantic))
        kept = relevant
        if settings.semantic.context is not None:
            forward = cloud.look_up(completed.depth)
            kept = relevant | radius_gather(cloud.points, forward, cloud.points[relevant], settings.semantic.context)
        steps.append(("+ semantic mask", cloud.select(relevant)))
        cloud = cloud.select(kept)
        steps.append(("+ context", cloud))
        if settings.near_lidar is not None:
            near = radius_gather(cloud.points, cloud.look_up(completed.depth), frame.points, settings.near_lidar)
            steps.append(("+ near raw LiDAR", cloud.select(near)))
    return steps


def study(
    frames: Iterable[StudyFrame], settings: AugmentSettings, taxonomy: Taxonomy
) -> tuple[dict[str, dict[str, float]], SigmaSweep]:
    """Step -> row of the table, and the sigma sweep, summed over frames."""
    tallies: dict[str, StepTally] = {}
    sweep = SigmaSweep()
    for frame in frames:
        objects = object_score(frame.semantics, settings.classes) > 0
        labels = label_noise(frame.completed.depth, frame.truth, objects, taxonomy)
        sweep.add(frame.completed, labels)
        for name, cloud in steps_of_frame(frame, settings):
            tally = tallies.setdefault(name, StepTally())
            point_labels = cloud.look_up(labels)
            tally.labels += np.bincount(point_labels, minlength=len(LABELS))
            clean_object = cloud.points[(point_labels == CLEAN) & cloud.look_up(objects)]
            tally.object_cells += len(np.unique(np.floor(clean_object / np.float32(0.2)), axis=0))
    first = tallies.get("completed depth", StepTally())
    return {name: tally.row(first) for name, tally in tallies.items()}, sweep


def markdown_table(rows: dict[str, dict[str, float]]) -> str:
    """The steps as a Markdown table; the sentence below it says what the sigma filter removed."""
    names = list(next(iter(rows.values())))
    lines = ["| step | " + " | ".join(names) + " |", "|" + "---|" * (len(names) + 1)]
    for step, row in rows.items():
        cells = [f"{row[name]:,}" if isinstance(row[name], int) else f"{row[name]:.1f}" for name in names]
        lines.append(f"| {step} | " + " | ".join(cells) + " |")
    filtered = rows.get("+ sigma filter")
    if filtered is not None:
        removed = 100 - filtered["noise-inbet left %"]
        lost = 100 - filtered["object recall %"]
        lines += ["", f"The sigma filter removes {removed:.1f} % of noise-inbet and {lost:.1f} % of the object cells."]
    return "\n".join(lines) + "\n"


def sweep_figure(sweep: SigmaSweep, settings: AugmentSettings, path: Path) -> Path:
    """Fig. 5.6a with the labels' densities, and what other thresholds would remove and lose."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    figure = Figure(figsize=(13, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2)
    for axis, density, title in zip(axes[0], sweep.density, ("noise-inbet", "clean")):
        image = axis.imshow(np.log10(1 + density.T), origin="lower", extent=(0, 1, 0, 12), aspect="auto", cmap="magma")
        axis.set(title=f"{title} points", xlabel="sigma", ylabel="background - foreground (m)")
        figure.colorbar(image, ax=axis, label="log10(1 + points)")
        if settings.sigma is not None:
            band = settings.sigma
            box = Rectangle((band.low, band.gap), band.high - band.low, 12 - band.gap, fill=False, color="deepskyblue")
            axis.add_patch(box)
    titles = ("noise-inbet removed (%)", "clean points lost (%)")
    for axis, share, title in zip(axes[1], sweep.shares(), titles):
        image = axis.imshow(share.T, origin="lower", aspect="auto", cmap="viridis")
        axis.set(title=title, xlabel="low (high = 1 - low)", ylabel="gap (m)")
        axis.set_xticks(range(len(LOWS)), [f"{low:g}" for low in LOWS])
        axis.set_yticks(range(len(GAPS)), [f"{gap:g}" for gap in GAPS])
        for i, j in np.ndindex(share.shape):
            colour = "white" if share[i, j] < (share.min() + share.max()) / 2 else "black"
            axis.text(i, j, f"{share[i, j]:.1f}", ha="center", va="center", color=colour, fontsize=7)
        figure.colorbar(image, ax=axis)
    figure.savefig(path, dpi=110)
    return path


def read_completed(folder: Path, frame_id: str, image_size: tuple[int, int]) -> CompletedDepth:
    """The completed depth of one frame from a run folder (it has a folder depth/) or a folder of PNGs.

    Depth without surfaces gets those of `pseudo_sigma`. Raises DataError when a file is missing or damaged.
    """
    run = RunFolder(folder)
    if run.depth(frame_id).parent.is_dir():
        completed = FrameOutputs(run, frame_id).read_completed()
    else:
        completed = read_depth_folder(folder, frame_id, image_size)
    return completed if completed.has_surfaces else pseudo_sigma(completed.depth)


def dataset_frames(data: Path, completed: Path, selection: str | None) -> Iterable[StudyFrame]:
    """Frames of a KITTI-layout data set with the completed depth of a folder."""
    from pipeline.data import open_dataset

    dataset = open_dataset("kitti_object", data)
    for frame in dataset if selection is None else dataset.select(selection):
        estimate = read_completed(completed, frame.id, frame.image_size)
        yield StudyFrame(estimate, frame.target_depth, frame.semantics, frame.points, frame.calibration)


def main(arguments: list[str] | None = None) -> None:
    """The command of the file's first lines."""
    parser = argparse.ArgumentParser(description="What each point-cloud step does to the three kinds of noise.")
    parser.add_argument("--data", type=Path, required=True, help="KITTI-layout data set with depth_2 and semantic_2")
    parser.add_argument("--completed", action="append", required=True, metavar="NAME=FOLDER")
    parser.add_argument("--frames", default=None, help="a:b or a file with one id per line")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    settings, taxonomy = AugmentSettings(), Taxonomy()
    results: dict[str, Any] = {}
    text = []
    for named in options.completed:
        name, separator, folder = named.partition("=")
        if not separator:
            parser.error(f"--completed: expected NAME=FOLDER, got {named}")
        rows, sweep = study(dataset_frames(options.data, Path(folder), options.frames), settings, taxonomy)
        if not rows:
            parser.error(f"--data: no frame chosen in {options.data}")
        removed, lost = sweep.shares()
        swept = {
            "low": LOWS,
            "gap": GAPS,
            "inbet_removed_percent": removed.tolist(),
            "clean_lost_percent": lost.tolist(),
        }
        results[name] = {"steps": rows, "sweep": swept}
        sweep_figure(sweep, settings, options.out / f"sigma_sweep_{name}.png")
        text.append(f"## {name}\n\n{markdown_table(rows)}")
    (options.out / "cloud_study.json").write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    (options.out / "cloud_study.md").write_text("\n".join(text), encoding="utf-8")
    print("\n".join(text))


if __name__ == "__main__":
    main()
