"""Which points lie in which boxes, with numba."""

from __future__ import annotations

from typing import Any

import numpy as np

from detection.ops._numba import kernel

STRIP = 64  # points tested at once
_NOWHERE = 1e30  # where the spare lanes of the last strip lie


@kernel
def _strips_of(points: Any) -> Any:
    """(strips, 3, 64) copy of points (N, 3), so that one test runs over neighbouring numbers."""
    strips = np.full(((points.shape[0] + STRIP - 1) // STRIP, 3, STRIP), _NOWHERE, points.dtype)
    for i in range(points.shape[0]):
        for axis in range(3):
            strips[i // STRIP, axis, i % STRIP] = points[i, axis]
    return strips


@kernel
def _inside_strip(strips: Any, strip: int, box: Any, near: Any, inside: Any) -> int:
    """inside (64,) uint8 for the points of one strip; returns how many are.

    box   x y z of the bottom centre, h w l, cos ry, sin ry
    near  points farther than this from the box's centre in x or in z are outside in any case (m)
    """
    half_h, half_w, half_l = box[3] / 2, box[4] / 2, box[5] / 2
    x, y, z, cos, sin = box[0], box[1] - half_h, box[2], box[6], box[7]
    found: Any = 0
    for lane in range(STRIP):
        dx, dy, dz = strips[strip, 0, lane] - x, strips[strip, 1, lane] - y, strips[strip, 2, lane] - z
        along, across = dx * cos - dz * sin, dx * sin + dz * cos
        reached = (abs(dx) <= near) & (abs(dz) <= near) & (abs(dy) <= half_h)
        hit = np.uint8(reached & (abs(along) <= half_l) & (abs(across) <= half_w))
        inside[lane] = hit
        found += hit
    return found


@kernel
def in_boxes(points: Any, boxes: Any, near: Any, out: Any) -> None:
    """out (B, M, N) uint8, zero before: points (B, N, 3) inside boxes (B, M, 8), see `_inside_strip`."""
    count = points.shape[1]
    inside = np.empty(STRIP, np.uint8)
    for batch in range(points.shape[0]):
        strips = _strips_of(points[batch])
        for m in range(boxes.shape[1]):
            for strip in range(strips.shape[0]):
                if _inside_strip(strips, strip, boxes[batch, m], near, inside):
                    first = strip * STRIP
                    stop = min(first + STRIP, count)
                    out[batch, m, first:stop] = inside[: stop - first]


@kernel
def _first_inside(strips: Any, box: Any, near: Any, inside: Any, out: Any) -> int:
    """Write the lowest indices of points inside `box` to out (S,); returns how many, S at most."""
    found = 0
    for strip in range(strips.shape[0]):
        if _inside_strip(strips, strip, box, near, inside):
            for lane in range(STRIP):
                if inside[lane]:
                    out[found] = strip * STRIP + lane
                    found += 1
                    if found == out.size:
                        return found
    return found


@kernel
def first_in_boxes(points: Any, boxes: Any, near: Any, out: Any, empty: Any) -> None:
    """out (B, M, S) int64: the S lowest indices of points (B, N, 3) inside boxes (B, M, 8), repeated in a cycle.

    empty (B, M) uint8: boxes without points, whose row of `out` is 0.
    """
    inside = np.empty(STRIP, np.uint8)
    for batch in range(points.shape[0]):
        strips = _strips_of(points[batch])
        for m in range(boxes.shape[1]):
            found = _first_inside(strips, boxes[batch, m], near, inside, out[batch, m])
            empty[batch, m] = found == 0
            for slot in range(found, out.shape[2]):
                out[batch, m, slot] = out[batch, m, slot - found] if found else 0
