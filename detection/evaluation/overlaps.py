"""Overlaps of labels and detections of the same frame in the image, from above and in 3D, as lists of pairs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detection.evaluation.objects import Array, Mask, ObjectTable
from detection.ops._numba import kernel
from detection.ops.rotated_iou import bev_intersection

OVERLAPS = ("2d", "bev", "3d")

Index = NDArray[np.int64]


@dataclass(frozen=True)
class Overlaps:
    """Which detections overlap which label, and by how much.

    start      (G + 1,) int64; the pairs of label g are start[g] to start[g + 1], detections in file order
    detection  (P,) int64 row of the detection
    iou        (P,) intersection over union, above the floor asked for
    dontcare   (D,) largest share of a detection that lies in one DontCare area, 0 where none
    """

    start: Index
    detection: Index
    iou: Array
    dontcare: Array


def overlaps_of(
    labels: ObjectTable, detections: ObjectTable, kind: str, *, floor: float, dontcare: Mask | None = None
) -> Overlaps:
    """Pairs with IoU above `floor` and the DontCare share of every detection.

    kind      "2d" (image boxes), "bev" (rotated rectangles on the ground) or "3d"
    dontcare  (G,) which labels are DontCare areas (they form no pairs); None = none
    """
    if kind not in OVERLAPS:
        raise ValueError(f"overlap kind: expected one of {', '.join(OVERLAPS)}, got {kind!r}")
    areas = np.zeros(len(labels), dtype=bool) if dontcare is None else dontcare
    offsets = (labels.offsets, detections.offsets)
    if kind == "2d":
        return Overlaps(*_image_pairs(*offsets, labels.boxes_2d, detections.boxes_2d, areas, floor))
    boxes = (_unsigned(labels.boxes_3d), _unsigned(detections.boxes_3d))
    return Overlaps(*_box_pairs(*offsets, *boxes, areas, floor, kind == "3d"))


def _unsigned(boxes: Array) -> Array:
    """Boxes with positive w and l: DontCare and 2D-only lines carry -1, the same rectangle to the devkit."""
    boxes[:, 4:6] = np.abs(boxes[:, 4:6])
    return boxes


@kernel
def _image_intersection(a: Array, b: Array) -> float:
    """Shared area of two boxes (4,) x1 y1 x2 y2."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    return width * height if width > 0 and height > 0 else 0.0


@kernel
def _image_area(box: Array) -> float:
    return (box[2] - box[0]) * (box[3] - box[1])


@kernel
def _image_pairs(
    label_offsets: Index, detection_offsets: Index, labels: Array, detections: Array, areas: Mask, floor: float
) -> tuple[Index, Index, Array, Array]:
    start = np.zeros(len(labels) + 1, dtype=np.int64)
    found = np.empty(len(detections) + 16, dtype=np.int64)
    iou = np.empty(len(detections) + 16, dtype=np.float64)
    dontcare = np.zeros(len(detections), dtype=np.float64)
    count = 0
    for f in range(len(label_offsets) - 1):
        for g in range(label_offsets[f], label_offsets[f + 1]):
            for d in range(detection_offsets[f], detection_offsets[f + 1]):
                shared = _image_intersection(detections[d], labels[g])
                if shared <= 0.0:
                    continue
                if areas[g]:
                    dontcare[d] = max(dontcare[d], shared / _image_area(detections[d]))
                    continue
                # Summed in the devkit's order, so that an IoU right at the limit rounds the same way.
                value = shared / (_image_area(detections[d]) + _image_area(labels[g]) - shared)
                if value > floor:
                    if count == len(found):
                        found = np.concatenate((found, np.empty_like(found)))
                        iou = np.concatenate((iou, np.empty_like(iou)))
                    found[count], iou[count] = d, value
                    count += 1
            start[g + 1] = count
    return start, found[:count].copy(), iou[:count].copy(), dontcare


@kernel
def _box_pairs(
    label_offsets: Index,
    detection_offsets: Index,
    labels: Array,
    detections: Array,
    areas: Mask,
    floor: float,
    solid: bool,
) -> tuple[Index, Index, Array, Array]:
    start = np.zeros(len(labels) + 1, dtype=np.int64)
    found = np.empty(len(detections) + 16, dtype=np.int64)
    iou = np.empty(len(detections) + 16, dtype=np.float64)
    dontcare = np.zeros(len(detections), dtype=np.float64)
    count = 0
    for f in range(len(label_offsets) - 1):
        for g in range(label_offsets[f], label_offsets[f + 1]):
            a = labels[g]
            for d in range(detection_offsets[f], detection_offsets[f + 1]):
                b = detections[d]
                shared = bev_intersection(a, b)
                if shared <= 0.0:
                    continue
                size_a, size_b = a[4] * a[5], b[4] * b[5]
                if solid:
                    shared *= max(0.0, min(a[1], b[1]) - max(a[1] - a[3], b[1] - b[3]))
                    size_a, size_b = size_a * a[3], size_b * b[3]
                if shared <= 0.0:
                    continue
                if areas[g]:
                    dontcare[d] = max(dontcare[d], shared / size_b)
                    continue
                value = shared / (size_a + size_b - shared)
                if value > floor:
                    if count == len(found):
                        found = np.concatenate((found, np.empty_like(found)))
                        iou = np.concatenate((iou, np.empty_like(iou)))
                    found[count], iou[count] = d, value
                    count += 1
            start[g + 1] = count
    return start, found[:count].copy(), iou[:count].copy(), dontcare
