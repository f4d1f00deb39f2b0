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
from completion.pictures import PICTURES
from detection.kitti_format import KittiObject
from detection.results import result_objects
from detection.types import PointFrame
from pipeline.base.errors import UsageError
from pipeline.benchmark.camera import COMPARED, distance_means, distance_sums, frame_pictures
from pipeline.benchmark.held_out_rings import BEAM_STRIDES, HeldOutFrame, hold_out, score
from pipeline.benchmark.object_recall import RecallReport, object_recall
from pipeline.data import Dataset, Frame
from pipeline.pointcloud.presets import PRESETS
from pipeline.run_folder.completers import open_completer
from pipeline.run_folder.detectors import open_detector
from pipeline.run_folder.thresholds import ScoreThresholds
from pipeline.training.thinned_clouds import thinned_cloud

Progress = Callable[[str], None]
Method = Callable[[NDArray[np.float32], NDArray[np.uint8]], NDArray[np.float32]]
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
    Methods that may look at the picture are tried with a flat one and another frame's too: "pictures" holds their
    scores by name, "distance" those of `camera.distance_means`.
    """
    methods = [(name, _method(name)) for name in names]
    if not methods:
        return []
    found: dict[tuple[str, int], dict[str, Tried]] = {}
    for index, frame_id in enumerate(dataset.ids):
        frame, pictures = dataset[frame_id], frame_pictures(dataset, index)
        for number in rows:
            held_out = hold_out(frame.points, frame.calibration, frame.image_size, number)
            for name, complete in methods:
                tried = found.setdefault((name, number), {})
                for picture in ("true",) if name in WITHOUT_WEIGHTS else PICTURES:
                    tried.setdefault(picture, Tried()).add(complete, held_out, pictures[picture])
        progress(f"completion {frame_id}")
    return [{"method": name, "rows": number} | _entry(tried) for (name, number), tried in found.items()]


@dataclass
class Tried:
    """A method with one kind of picture: its scores and sums over distance, frame by frame."""

    scores: list[dict[str, float]] = field(default_factory=list)
    sums: list[dict[str, NDArray[np.float64]]] = field(default_factory=list)

    def add(self, complete: Method, held_out: HeldOutFrame, picture: NDArray[np.uint8]) -> None:
        """One more frame."""
        start = time.perf_counter()
        depth = complete(held_out.sparse, picture)
        seconds = time.perf_counter() - start
        self.scores.append(score(depth, held_out) | {"seconds": seconds})
        self.sums.append(distance_sums(depth, held_out))


def _entry(tried: dict[str, Tried]) -> dict[str, Any]:
    """What is reported of a method: its scores with the true picture, and beside them those with the others."""
    means = {picture: _means(found.scores) for picture, found in tried.items()}
    if len(tried) == 1:
        return means["true"]
    compared = {picture: {name: mean[name] for name in COMPARED} for picture, mean in means.items()}
    distance = {picture: distance_means(found.sums) for picture, found in tried.items()}
    return means["true"] | {"pictures": compared, "distance": distance}


def _method(name: str) -> Method:
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
