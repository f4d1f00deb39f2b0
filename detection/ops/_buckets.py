"""Points cut into small boxes, so that a search round a place skips almost all of them without changing its result.

Points are sorted along a Morton curve and cut into buckets of 32; sixteen buckets make a block, sixteen blocks a group.
Each bucket and block knows its bounding box and its reach: the squared distance below which a place is of interest to
it. The distance from a place to a box is computed with the same float32 operations as the distance to a point, and
rounding is monotone, so it is a lower bound to the last bit: what is skipped could not have mattered.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from detection.ops._numba import kernel

Float = NDArray[np.float32]

BUCKET = 32  # points
FANOUT = 16  # buckets in a block, blocks in a group
_MORTON_BITS = 10  # per axis


@kernel
def _spread(value: np.uint32) -> Any:
    """The ten low bits of `value` with two zero bits between neighbours."""
    value = np.uint32(value & np.uint32(0x3FF))
    value = np.uint32((value | (value << np.uint32(16))) & np.uint32(0x30000FF))
    value = np.uint32((value | (value << np.uint32(8))) & np.uint32(0x300F00F))
    value = np.uint32((value | (value << np.uint32(4))) & np.uint32(0x30C30C3))
    return np.uint32((value | (value << np.uint32(2))) & np.uint32(0x9249249))


@kernel
def _morton_codes(xyz: Float) -> Any:
    """(N,) uint32 Morton codes over a cube that holds all points."""
    low, high = xyz[0].copy(), xyz[0].copy()
    for i in range(xyz.shape[0]):
        for axis in range(3):
            low[axis] = min(low[axis], xyz[i, axis])
            high[axis] = max(high[axis], xyz[i, axis])
    side = max(high[0] - low[0], high[1] - low[1], high[2] - low[2])
    cells = np.float32((1 << _MORTON_BITS) - 1)
    scale = cells / side if side > 0 else np.float32(0)
    codes = np.empty(xyz.shape[0], np.uint32)
    for i in range(xyz.shape[0]):
        code = np.uint32(0)
        for axis in range(3):
            cell = np.uint32(min((xyz[i, axis] - low[axis]) * scale, cells))
            code |= np.uint32(_spread(cell) << np.uint32(axis))
        codes[i] = code
    return codes


@kernel
def morton_order(xyz: Float) -> Any:
    """(N,) int32 point indices along the curve: a radix sort of the codes, ten bits at a time."""
    codes = _morton_codes(xyz)
    count = codes.size
    order = np.arange(count).astype(np.int32)
    other_codes, other_order = np.empty_like(codes), np.empty_like(order)
    for digit in range(3):
        shift = np.uint32(_MORTON_BITS * digit)
        starts = np.zeros((1 << _MORTON_BITS) + 1, np.int32)
        for i in range(count):
            starts[((codes[i] >> shift) & np.uint32(0x3FF)) + 1] += 1
        for value in range(1 << _MORTON_BITS):
            starts[value + 1] += starts[value]
        for i in range(count):
            value = (codes[i] >> shift) & np.uint32(0x3FF)
            other_codes[starts[value]] = codes[i]
            other_order[starts[value]] = order[i]
            starts[value] += 1
        codes, other_codes = other_codes, codes
        order, other_order = other_order, order
    return order


@kernel
def _fill_buckets(xyz: Float, order: Any, reach: Any, points: Float, owner: Any) -> None:
    """points (buckets, 4, 32): x, y, z, reach; owner (buckets, 32): index of the point.

    Spare slots repeat the last point with reach -1: they are never of interest and never widen a box.
    """
    count = order.size
    for slot in range(owner.size):
        bucket, lane = slot // BUCKET, slot % BUCKET
        index = order[min(slot, count - 1)]
        for axis in range(3):
            points[bucket, axis, lane] = xyz[index, axis]
        points[bucket, 3, lane] = reach if slot < count else np.float32(-1)
        owner[bucket, lane] = index


@kernel
def _fill_boxes(points: Float, reach: Any, boxes: Float, groups: Float) -> None:
    """boxes (blocks, 7, 16) of buckets, groups (groups, 7, 16) of blocks: low xyz, high xyz, reach."""
    boxes[:, :6] = np.inf
    groups[:, :6] = np.inf
    boxes[:, 6] = -1.0
    groups[:, 6] = -1.0
    for bucket in range(points.shape[0]):
        block, lane = bucket // FANOUT, bucket % FANOUT
        group, group_lane = block // FANOUT, block % FANOUT
        for axis in range(3):
            low, high = points[bucket, axis].min(), points[bucket, axis].max()
            boxes[block, axis, lane] = low
            boxes[block, 3 + axis, lane] = high
            first = lane == 0
            groups[group, axis, group_lane] = low if first else min(low, groups[group, axis, group_lane])
            groups[group, 3 + axis, group_lane] = high if first else max(high, groups[group, 3 + axis, group_lane])
        boxes[block, 6, lane] = reach
        groups[group, 6, group_lane] = reach


@kernel
def build(xyz: Float, reach: Any) -> Any:
    """Buckets of xyz (N, 3) float32, N >= 1, where every point has the same reach (m^2).

    Returns points (buckets, 4, 32), owner (buckets, 32) int32, boxes (blocks, 7, 16), groups (groups, 7, 16); children
    are consecutive: bucket = block * 16 + lane, block = group * 16 + lane.
    """
    buckets = (xyz.shape[0] + BUCKET - 1) // BUCKET
    blocks = (buckets + FANOUT - 1) // FANOUT
    points = np.empty((buckets, 4, BUCKET), np.float32)
    owner = np.empty((buckets, BUCKET), np.int32)
    boxes = np.empty((blocks, 7, FANOUT), np.float32)
    groups = np.empty(((blocks + FANOUT - 1) // FANOUT, 7, FANOUT), np.float32)
    _fill_buckets(xyz, morton_order(xyz), reach, points, owner)
    _fill_boxes(points, reach, boxes, groups)
    return points, owner, boxes, groups


@kernel
def mark_near(boxes: Float, node: int, x: Any, y: Any, z: Any, near: Any) -> None:
    """near (16,) uint8: which children of `node` have x y z within their reach (squared distance below it)."""
    zero = np.float32(0)
    for lane in range(FANOUT):
        dx = max(boxes[node, 0, lane] - x, x - boxes[node, 3, lane])
        dy = max(boxes[node, 1, lane] - y, y - boxes[node, 4, lane])
        dz = max(boxes[node, 2, lane] - z, z - boxes[node, 5, lane])
        dx, dy, dz = max(dx, zero), max(dy, zero), max(dz, zero)
        near[lane] = (dx * dx + dy * dy) + dz * dz < boxes[node, 6, lane]
