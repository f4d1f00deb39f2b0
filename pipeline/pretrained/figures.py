"""Figures of networks on held-out synthetic frames, as they stand on the cards of the bundled weights."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from detection.kitti_format import KittiObject
from pipeline.benchmark.object_recall import object_recall
from pipeline.data import Dataset
from pipeline.geometry.project import project_points
from pipeline.geometry.rings import subsample_rows

ROWS = (64, 32, 16, 8)
# Share of right detections that score thresholds are chosen for, and the overlap from above that makes one
# right. People are half a metre wide: at 0.5 a box a hand's breadth aside is wrong, and no score is sure enough.
PRECISION = 0.8
CLASS_IOU = {"Car": 0.7, "Pedestrian": 0.25, "Cyclist": 0.25}


@dataclass(frozen=True)
class HeldOut:
    """Frames to measure on, and for detectors the clouds they are given: a preset and its completion."""

    dataset: Dataset
    cloud: str = "L"
    completer: str = "classical"

    def figures(self, room: str, weights: Path) -> dict[str, Any]:
        """The figures of a card, and which frames they are from."""
        if room == "completion":
            found = completion_figures(weights, self.dataset)
        elif room == "detection":
            found = detection_figures(weights, self)
        else:
            found = segmentation_figures(weights, self.dataset)
        return {**self.which, **found}

    @cached_property
    def which(self) -> dict[str, Any]:
        """How many frames these are, and a hash of their ids and labels that tells them from others."""
        content = [(frame.id, [str(label) for label in frame.labels]) for frame in self.dataset]
        return {"frames": len(content), "labels": hashlib.sha256(repr(content).encode()).hexdigest()[:12]}


def completion_figures(weights: Path, dataset: Dataset) -> dict[str, Any]:
    """Errors on dense truth by LiDAR rows: `completion.diagnostics.diagnose` (mm, %), mean over frames."""
    from completion.diagnostics import diagnose
    from completion.infer import load_completer
    from completion.types import DepthFrame

    completer = load_completer(str(weights), backend="auto")
    figures: dict[str, Any] = {}
    for rows in ROWS:
        frames = (
            DepthFrame(
                frame.image,
                project_points(subsample_rows(frame.points, 64 // rows), frame.calibration, frame.image_size),
                frame.target_depth,
            )
            for frame in dataset
        )
        figures[f"{rows} rows"] = {key: round(value, 4) for key, value in diagnose(completer, frames).items()}
    return figures


def detection_figures(weights: Path, held_out: HeldOut) -> dict[str, Any]:
    """AP at 64 and 16 rows; for every class the threshold chosen at 64 (`operating_point`), and its effect at both."""
    labels, found = detections(weights, held_out, 64)
    few_labels, few = detections(weights, held_out, 16)
    figures: dict[str, Any] = {}
    for name in CLASS_IOU:
        chosen = operating_point(labels, found, name)
        figures[at_threshold(name)] = chosen
        figures[f"{at_threshold(name)}, 16 rows"] = recall_at(few_labels, few, chosen["threshold"], name)
    return figures | {
        "ap_r40": average_precision(labels, found),
        "ap_r40, 16 rows": average_precision(few_labels, few),
    }


def at_threshold(name: str) -> str:
    """Key of a class' recall and precision in the figures of a card."""
    return f"{name.lower()}, BEV IoU {CLASS_IOU[name]:g}, hard"


def thresholds(figures: dict[str, Any]) -> dict[str, float]:
    """Class -> score from which its detections are shown, of the figures of a detector."""
    return {name: figures[at_threshold(name)]["threshold"] for name in CLASS_IOU}


Objects = list[list[KittiObject]]


def detections(weights: Path, held_out: HeldOut, rows: int) -> tuple[Objects, Objects]:
    """Labels and detections of all frames, their clouds made from so many LiDAR rows."""
    from completion.infer import load_completer
    from detection.infer import load_detector
    from detection.results import result_objects
    from detection.types import PointFrame
    from pipeline.benchmark.suite import DetectionRow, augmented_points

    detector = load_detector(str(weights))
    complete = load_completer(held_out.completer, backend="auto")
    labels, found = [], []
    for frame in held_out.dataset:
        points = augmented_points(frame, DetectionRow(str(weights), held_out.cloud, rows), complete)
        camera = frame.calibration
        seen = PointFrame(points, camera.T_cam_velo, camera.P2, frame.image_size, frame.id)
        labels.append(frame.labels)
        found.append(result_objects(detector.detect(seen), seen))
    return labels, found


def average_precision(labels: Objects, found: Objects) -> dict[str, list[float | None]]:
    """AP R40 easy, moderate, hard by "CLASS METRIC IOU"; from above and in 3D."""
    from detection.evaluation.kitti_ap import evaluate

    return {
        f"{row['class']} {row['metric']} {row['iou']}": [row["easy"], row["moderate"], row["hard"]]
        for row in evaluate(labels, found)["results"]
        if row["metric"] in ("bev", "3d")
    }


def operating_point(labels: Objects, found: Objects, name: str = "Car") -> dict[str, float]:
    """The lowest score from which `PRECISION` of what is reported as a class is right (BEV, `CLASS_IOU`); recall there.

    Where no score reaches that, the one with the best balance of both (the largest F1).
    """
    points = [recall_at(labels, found, round(float(score), 3), name) for score in np.arange(0.1, 0.96, 0.025)]
    enough = [point for point in points if point["precision"] >= PRECISION]
    return enough[0] if enough else max(points, key=_balance)


def _balance(point: dict[str, float]) -> float:
    recall, precision = np.nan_to_num([point["recall"], point["precision"]])
    return float(2 * recall * precision / max(recall + precision, 1e-9))


def recall_at(labels: Objects, found: Objects, threshold: float, name: str = "Car") -> dict[str, float]:
    """Recall of a class up to "hard" and precision (BEV, `CLASS_IOU`) of detections from this score on."""
    report = object_recall(
        labels, found, iou=CLASS_IOU[name], metric="bev", score_threshold=threshold, object_class=name
    )
    return {"threshold": threshold, "recall": report.by_level["hard"].share, "precision": report.precision}


def segmentation_figures(weights: Path, dataset: Dataset) -> dict[str, Any]:
    """Share of pixels with the right class, IoU of vehicles (car, truck, bus) and people, over all frames.

    "points" are the shares of `pipeline.benchmark.mask_points`, by which masks are measured on real frames.
    """
    from pipeline.benchmark.mask_points import mask_scores
    from pipeline.semantics.conventions import CLASSES, NONE
    from pipeline.semantics.sources import open_semantics

    masks = open_semantics(f"network:{weights}")
    groups = {"vehicle_iou": ("car", "truck", "bus"), "people_iou": ("person", "rider")}
    right = counted = 0
    both, either = dict.fromkeys(groups, 0), dict.fromkeys(groups, 0)
    for frame in dataset:
        found, known = masks.semantics(frame), frame.semantics != NONE
        right += int((found == frame.semantics)[known].sum())
        counted += int(known.sum())
        for name, classes in groups.items():
            numbers = [CLASSES.index(each) for each in classes]
            ours, theirs = np.isin(found, numbers) & known, np.isin(frame.semantics, numbers)
            both[name] += int((ours & theirs).sum())
            either[name] += int((ours | theirs).sum())
    points = {
        entry["group"]: {key: round(entry[key], 4) for key in ("precision", "recall", "iou") if entry[key] is not None}
        for entry in mask_scores(dataset, {"network": masks}, lambda _: None)
    }
    shares = {name: round(both[name] / max(either[name], 1), 4) for name in groups}
    return {"pixel_accuracy": round(right / max(counted, 1), 4), **shares, "points": points}
