"""The suite "real": completion on held-out rings and objects found, on the frames of a KITTI object folder."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from completion.infer import Completer
from completion.models.classical import ClassicalCompleter
from detection.kitti_format import KittiObject
from detection.results import result_objects
from detection.types import PointFrame
from pipeline.base.errors import UsageError
from pipeline.benchmark.held_out_rings import BEAM_STRIDES, hold_out, score
from pipeline.benchmark.object_recall import RecallReport, object_recall
from pipeline.data import Dataset, Frame
from pipeline.pointcloud.presets import PRESETS
from pipeline.run_folder.completers import open_completer
from pipeline.run_folder.detectors import open_detector
from pipeline.run_folder.thresholds import ScoreThresholds
from pipeline.training.thinned_clouds import thinned_cloud

Progress = Callable[[str], None]
# Overlaps asked of each class: KITTI's own, and its loose one (people are small: 0.25 is a quarter of a step aside).
IOUS = {"Car": (0.5, 0.7), "Pedestrian": (0.25, 0.5), "Cyclist": (0.25, 0.5)}
WITHOUT_WEIGHTS = ("nearest", "classical")


@dataclass(frozen=True)
class DetectionRow:
    """One detector on one kind of input.

    rows    LiDAR rows given to completion and detector: 64 or 16
    preset  "L" for raw LiDAR, else the preset of the augmented cloud
    least   scores from which its detections count
    """

    detector: str
    preset: str
    rows: int
    least: ScoreThresholds = field(default_factory=ScoreThresholds)


def completion_scores(
    dataset: Dataset, names: Iterable[str], rows: Iterable[int], progress: Progress
) -> list[dict[str, Any]]:
    """Mean scores over frames, one entry per method and number of rows; see `held_out_rings.score` for the keys.

    names  "nearest", "classical" (linear in inverse depth), or weights or module:Class as `open_completer` takes them
    """
    methods = [(name, _method(name)) for name in names]
    if not methods:
        return []
    found: dict[tuple[str, int], list[dict[str, float]]] = {}
    for frame_id in dataset.ids:
        frame = dataset[frame_id]
        for number in rows:
            held_out = hold_out(frame.points, frame.calibration, frame.image_size, number)
            for name, complete in methods:
                start = time.perf_counter()
                depth = complete(held_out.sparse, frame.image)
                seconds = time.perf_counter() - start
                found.setdefault((name, number), []).append(score(depth, held_out) | {"seconds": seconds})
        progress(f"completion {frame_id}")
    return [{"method": name, "rows": number} | _means(entries) for (name, number), entries in found.items()]


def _method(name: str) -> Callable[[NDArray[np.float32], NDArray[np.uint8]], NDArray[np.float32]]:
    completer: Completer = ClassicalCompleter("nearest") if name == "nearest" else open_completer(name, backend="auto")
    return lambda sparse, image: completer.complete(sparse, image).depth


def _means(entries: list[dict[str, float]]) -> dict[str, Any]:
    """Plain means over frames; NaN entries (too few clean windows) are left out, time by its median."""
    means: dict[str, Any] = {"frames": len(entries)}
    for key in entries[0]:
        values = np.array([entry[key] for entry in entries])
        usable = values[np.isfinite(values)]
        summary = np.median if key == "seconds" else np.mean
        means[key] = float(summary(usable)) if len(usable) else None
    return means


def detection_scores(dataset: Dataset, rows: Iterable[DetectionRow], completer: str, progress: Progress) -> list[Any]:
    """Recall and precision of every class for every row, from above and in 3D at two overlaps (`IOUS`)."""
    complete = open_completer(completer, backend="auto")
    results = []
    for row in rows:
        detector = open_detector(row.detector, seed=0)
        labels, detections = [], []
        for frame_id in dataset.ids:
            frame = dataset[frame_id]
            cloud = PointFrame(
                augmented_points(frame, row, complete),
                frame.calibration.T_cam_velo,
                frame.calibration.P2,
                frame.image_size,
                frame.id,
            )
            labels.append(frame.labels)
            detections.append(result_objects(detector.detect(cloud), cloud))
            progress(f"{row.detector} {row.preset} {row.rows} rows {frame_id}")
        shown = [[item for item in items if row.least.shows(item)] for items in detections]
        results.append(_record(row) | {"reports": _reports(labels, shown)})
    return results


def augmented_points(frame: Frame, row: DetectionRow, complete: Completer) -> NDArray[np.float32]:
    """The cloud of a row: raw points, or the preset's augmented cloud; (N, 4 or 5) LiDAR frame."""
    settings = None if row.preset == "L" else PRESETS[row.preset]
    return thinned_cloud(frame, 64 // row.rows, settings, complete, seed=0)


def _record(row: DetectionRow) -> dict[str, Any]:
    thresholds = {name: row.least.of(name) for name in IOUS if row.least.of(name) > -np.inf}
    return {"detector": row.detector, "preset": row.preset, "rows": row.rows, "thresholds": thresholds}


def _reports(labels: list[list[KittiObject]], detections: list[list[KittiObject]]) -> list[dict[str, Any]]:
    return [
        {"class": name} | _plain(object_recall(labels, detections, iou=iou, metric=metric, object_class=name))
        for name, ious in IOUS.items()
        for metric in ("bev", "3d")
        for iou in ious
    ]


def _plain(report: RecallReport) -> dict[str, Any]:
    levels = {name: [value.found, value.total] for name, value in report.by_level.items()}
    distances = {f"{a:g}-{b:g}": [value.found, value.total] for (a, b), value in report.by_distance.items()}
    return {
        "metric": report.metric,
        "iou": report.iou,
        "found": levels,
        "found_by_distance": distances,
        "precision": None if np.isnan(report.precision) else report.precision,
        "false": report.false_detections,
    }


def row_numbers(text: str) -> list[int]:
    """'32,16,8' -> [32, 16, 8]. UsageError for other numbers of rows."""
    numbers = [int(part) for part in text.split(",") if part.strip().isdigit()]
    if not numbers or any(number not in BEAM_STRIDES for number in numbers):
        raise UsageError(f"rows: expected some of {', '.join(map(str, BEAM_STRIDES))}, got {text!r}")
    return numbers
