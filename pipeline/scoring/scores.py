"""The evaluate stage: labels, detections and depth of a run -> metrics.json and tables.md."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from auglidar_base.atomic import write_text
from detection.kitti_format import KittiObject
from pipeline.base.errors import DataError
from pipeline.base.paths import RunFolder
from pipeline.data import Dataset, Frame
from pipeline.data.depth_png import read_depth_png
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.runner.jobs import Failure
from pipeline.scoring.tables import markdown_tables

# Share of pixels with a value from which ground truth counts as dense; KITTI's accumulated LiDAR has 16 to 30 %.
DENSE_TRUTH = 0.5


@dataclass
class Collected:
    """Everything the scores are made of, gathered frame by frame."""

    labels: dict[str, list[KittiObject]] = field(default_factory=dict)
    detections: dict[str, list[KittiObject]] = field(default_factory=dict)
    depth: dict[str, dict[str, float]] = field(default_factory=dict)
    steps: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    unlabelled: list[str] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)


def evaluate_run(config: Config, run: RunFolder, dataset: Dataset, frames: Sequence[str]) -> Collected:
    """Scores what lies in the run folder and writes metrics.json and tables.md.

    frames  those that were processed; a frame without a label is listed and the others are scored
    """
    collected = collect(run, dataset, frames)
    metrics = scores(config, collected)
    write_text(run.metrics, json.dumps(metrics, indent=1) + "\n")
    write_text(run.tables, markdown_tables(metrics))
    return collected


def collect(run: RunFolder, dataset: Dataset, frames: Sequence[str]) -> Collected:
    """Labels, detections, depth errors and point counts of the frames. Damage in one frame is noted, others go on."""
    collected = Collected()
    for frame_id in frames:
        frame, files = dataset[frame_id], FrameOutputs(run, frame_id)
        try:
            _collect_objects(frame, files, collected)
            _collect_depth(frame, files, collected)
            if run.counts(frame_id).is_file():
                collected.steps[frame_id] = files.read_counts()["steps"]
        except DataError as error:
            parts = (error.where, error.expected, error.found, error.hint)
            collected.failures.append(Failure("evaluate", frame_id, "data", *parts))
    if collected.labels:
        # Some frames have labels, so one without is a gap in the data set; a test set has none at all.
        collected.failures += [_no_label(dataset, frame_id) for frame_id in collected.unlabelled]
    return collected


def _collect_objects(frame: Frame, files: FrameOutputs, collected: Collected) -> None:
    if not files.run.detections(frame.id).is_file():
        return
    if not frame.has("labels"):
        collected.unlabelled.append(frame.id)
        return
    collected.labels[frame.id] = frame.labels
    collected.detections[frame.id] = files.read_detections()


def _no_label(dataset: Dataset, frame_id: str) -> Failure:
    hint = "the frame was processed but is not scored"
    return Failure("evaluate", frame_id, "data", f"{dataset.root} frame {frame_id}", "a label file", "none", hint)


def _collect_depth(frame: Frame, files: FrameOutputs, collected: Collected) -> None:
    path = files.run.depth(frame.id)
    if not frame.has("target_depth") or not path.is_file():
        return
    from completion.metrics import depth_metrics

    target = scored_depth(frame)
    if (target > 0).any():
        collected.depth[frame.id] = depth_metrics(read_depth_png(path), target)


def scored_depth(frame: Frame) -> NDArray[np.float32]:
    """True depth (H, W) that completion is scored on, metres, 0 = not scored.

    Truth measured by a LiDAR is taken whole, as the KITTI devkit does. Dense truth of a renderer reaches to the
    horizon and above every ring; it is scored where a LiDAR measures: up to 80 m and below the topmost sample.
    """
    from completion.diagnostics import measured_region
    from completion.types import DepthFrame

    target = frame.target_depth
    if (target > 0).mean() < DENSE_TRUTH:
        return target
    return measured_region(DepthFrame(frame.image, frame.sparse_depth, target))


def scores(config: Config, collected: Collected) -> dict[str, Any]:
    """The contents of metrics.json: AP rows as `--stage evaluate --json`, depth errors, point counts per step."""
    metrics: dict[str, Any] = {
        "results": [],
        "frames": {
            "scored": sorted(collected.labels),
            "without_label": sorted(collected.unlabelled),
        },
        "depth": {"frames": len(collected.depth), "mean": mean_of(collected.depth.values())},
        "augmentation": mean_steps(collected.steps.values()),
    }
    if collected.labels:
        from detection.evaluation.kitti_ap import evaluate

        metrics.update(evaluate(collected.labels, collected.detections, config.evaluation))
    return metrics


def mean_of(rows: Iterable[dict[str, float]]) -> dict[str, float]:
    """Mean over frames of every measure that all frames have."""
    values: dict[str, list[float]] = defaultdict(list)
    count = 0
    for row in rows:
        count += 1
        for name, value in row.items():
            values[name].append(float(value))
    return {name: sum(column) / count for name, column in values.items() if len(column) == count}


def mean_steps(frames: Iterable[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Mean points in and out of every augmentation step, in the order of the steps."""
    found: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for steps in frames:
        for step in steps:
            found[step["step"]].append((step["in"], step["out"]))
    return [
        {
            "step": name,
            "in": round(sum(before for before, _ in counts) / len(counts)),
            "out": round(sum(after for _, after in counts) / len(counts)),
        }
        for name, counts in found.items()
    ]
