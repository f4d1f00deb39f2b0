"""Recall and precision of detected objects of a class on a handful of labelled frames, where AP would say little.

AP over forty recall levels needs hundreds of objects. With eleven frames the honest questions are: of the objects a
level asks for, how many were found; of what was reported, how much was right; and how both change with distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detection.kitti_format import KittiObject, boxes_of
from detection.ops.rotated_iou import iou_3d, iou_bev

LEVELS = ("easy", "moderate", "hard")
# KITTI's limits per level: 2D height in pixels, occlusion state, truncation share (devkit, evaluate_object.cpp).
MIN_HEIGHT, MAX_OCCLUSION, MAX_TRUNCATION = (40, 25, 25), (0, 1, 2), (0.15, 0.30, 0.50)
DISTANCES = ((0.0, 20.0), (20.0, 40.0), (40.0, 70.0))
NEIGHBOURS = {"Car": "Van", "Pedestrian": "Person_sitting"}


@dataclass(frozen=True)
class Recall:
    """found of total objects."""

    found: int
    total: int

    @property
    def share(self) -> float:
        """found / total, NaN without objects."""
        return self.found / self.total if self.total else float("nan")


@dataclass(frozen=True)
class RecallReport:
    """recall by level and by distance range (metres, camera z), and precision = true / (true + false) detections."""

    iou: float
    metric: str
    by_level: dict[str, Recall]
    by_distance: dict[tuple[float, float], Recall]
    true_detections: int
    false_detections: int

    @property
    def precision(self) -> float:
        """NaN when nothing was detected."""
        reported = self.true_detections + self.false_detections
        return self.true_detections / reported if reported else float("nan")


def level_of(item: KittiObject) -> int | None:
    """0 easy, 1 moderate, 2 hard: the easiest level an object belongs to, or None outside all levels."""
    for level in range(3):
        if (
            item.height_2d >= MIN_HEIGHT[level]
            and item.occluded <= MAX_OCCLUSION[level]
            and item.truncated <= MAX_TRUNCATION[level]
        ):
            return level
    return None


def object_recall(
    labels: Sequence[Sequence[KittiObject]],
    detections: Sequence[Sequence[KittiObject]],
    *,
    iou: float,
    metric: str = "bev",
    score_threshold: float = -np.inf,
    object_class: str = "Car",
) -> RecallReport:
    """Matches detections to labels frame by frame, best score first, one detection to one object.

    iou     overlap a match must exceed, from above (metric "bev") or in 3D ("3d")
    A detection on an object that no level asks for (too small, too occluded, a Van) is neither true nor false, and so
    is one on a DontCare region or lower than 25 pixels in the image.
    """
    overlap = {"bev": iou_bev, "3d": iou_3d}[metric]
    found, total = np.zeros(3, dtype=int), np.zeros(3, dtype=int)
    found_at, total_at = np.zeros(len(DISTANCES), dtype=int), np.zeros(len(DISTANCES), dtype=int)
    true_count = false_count = 0
    for objects, results in zip(labels, detections, strict=True):
        cars = [item for item in objects if item.type in (object_class, NEIGHBOURS.get(object_class))]
        regions = np.array([item.bbox for item in objects if item.type == "DontCare"]).reshape(-1, 4)
        reported = sorted(
            (r for r in results if r.type == object_class and (r.score or 0) >= score_threshold),
            key=lambda r: -(r.score or 0),
        )
        pairs = overlap(boxes_of(reported).values, boxes_of(cars).values)
        taken = np.zeros(len(cars), dtype=bool)
        levels = [level_of(item) if item.type == object_class else None for item in cars]
        for result, row in zip(reported, np.where(pairs > iou, pairs, 0)):
            candidates = np.where(taken, 0, row)
            best = int(candidates.argmax()) if len(cars) else -1
            if best >= 0 and candidates[best] > 0:
                taken[best] = True
                true_count += levels[best] is not None
            elif result.height_2d >= MIN_HEIGHT[2] and not _in_region(result, regions):
                # A second detection of an object nobody asks for is as harmless as the first one.
                ignorable = any(row[k] > 0 and levels[k] is None for k in range(len(cars)))
                false_count += not ignorable
        for item, level, hit in zip(cars, levels, taken):
            if level is None:
                continue
            total[level:] += 1
            found[level:] += hit
            for k, (near, far) in enumerate(DISTANCES):
                if near <= item.location[2] < far:
                    total_at[k] += 1
                    found_at[k] += hit
    return RecallReport(
        iou,
        metric,
        {name: Recall(int(found[k]), int(total[k])) for k, name in enumerate(LEVELS)},
        {name: Recall(int(found_at[k]), int(total_at[k])) for k, name in enumerate(DISTANCES)},
        int(true_count),
        int(false_count),
    )


def _in_region(item: KittiObject, regions: NDArray[np.float64]) -> bool:
    """True when more than half of the detection's 2D box lies in one DontCare region."""
    x1, y1, x2, y2 = item.bbox
    area = max(x2 - x1, 0.0) * max(y2 - y1, 0.0)
    if not len(regions) or area == 0:
        return False
    width = np.minimum(x2, regions[:, 2]) - np.maximum(x1, regions[:, 0])
    height = np.minimum(y2, regions[:, 3]) - np.maximum(y1, regions[:, 1])
    return bool((np.maximum(width, 0) * np.maximum(height, 0)).max() > 0.5 * area)
