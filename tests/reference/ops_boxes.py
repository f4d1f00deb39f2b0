"""Rotated overlap by Shapely and NMS by its definition; boxes are x y z h w l ry in camera form."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import Polygon

Array = NDArray[np.float64]


def rectangle(box: Array, origin: Array) -> Polygon:
    """The box seen from above, relative to `origin` so that the comparison does not suffer from 70 m coordinates."""
    x, z = box[0] - origin[0], box[2] - origin[2]
    cos, sin = math.cos(box[6]), math.sin(box[6])
    corners = []
    for along, across in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        xl, zl = along * box[5] / 2, across * box[4] / 2
        corners.append((x + xl * cos + zl * sin, z - xl * sin + zl * cos))
    return Polygon(corners)


def shared_area(box_a: Array, box_b: Array) -> float:
    if min(box_a[4], box_a[5], box_b[4], box_b[5]) <= 0:
        return 0.0
    return float(rectangle(box_a, box_a).intersection(rectangle(box_b, box_a)).area)


def iou_bev(box_a: Array, box_b: Array) -> float:
    shared = shared_area(box_a, box_b)
    total = box_a[4] * box_a[5] + box_b[4] * box_b[5] - shared
    return shared / total if shared > 0 else 0.0


def iou_3d(box_a: Array, box_b: Array) -> float:
    height = max(0.0, min(box_a[1], box_b[1]) - max(box_a[1] - box_a[3], box_b[1] - box_b[3]))
    shared = shared_area(box_a, box_b) * height
    total = math.prod(box_a[3:6]) + math.prod(box_b[3:6]) - shared
    return shared / total if shared > 0 else 0.0


def matrix(pair: Callable[[Array, Array], float], boxes_a: Array, boxes_b: Array) -> Array:
    return np.array([[pair(a, b) for b in boxes_b] for a in boxes_a]).reshape(len(boxes_a), len(boxes_b))


def iou_unrotated(box_a: Array, box_b: Array) -> float:
    flat_a, flat_b = box_a.copy(), box_b.copy()
    flat_a[6] = flat_b[6] = 0.0
    return iou_bev(flat_a, flat_b)


def nms(boxes: Array, scores: Array, threshold: float, pair: Callable[[Array, Array], float]) -> list[int]:
    waiting = sorted(range(len(boxes)), key=lambda i: (-scores[i], i))
    kept = []
    while waiting:
        best = waiting.pop(0)
        kept.append(best)
        waiting = [other for other in waiting if not pair(boxes[best], boxes[other]) > threshold]
    return kept
