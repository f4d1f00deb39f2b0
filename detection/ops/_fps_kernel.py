"""Exact furthest point sampling with numba: the same indices as the plain loop, at a small part of its work.

A new sample can only change a bucket of points whose box is nearer to it than the largest distance that remains in the
bucket; almost all buckets are skipped (the idea of QuickFPS, Han et al., IEEE TCAD 2023).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from detection.ops._buckets import BUCKET, FANOUT, Float, build, mark_near
from detection.ops._numba import kernel

_FARTHEST = np.float32(1e10)  # where the running squared distances start, as in the reference kernel


@kernel
def _update_bucket(points: Float, bucket: int, x: Any, y: Any, z: Any) -> Any:
    """Shorten the running distances of one bucket by a sample at x y z; returns the largest that remains."""
    largest = np.float32(-1)
    for lane in range(BUCKET):
        dx, dy, dz = points[bucket, 0, lane] - x, points[bucket, 1, lane] - y, points[bucket, 2, lane] - z
        distance = min((dx * dx + dy * dy) + dz * dz, points[bucket, 3, lane])
        points[bucket, 3, lane] = distance
        largest = max(largest, distance)
    return largest


@kernel
def _largest_of(boxes: Float, node: int) -> Any:
    largest = np.float32(-1)
    for lane in range(FANOUT):
        largest = max(largest, boxes[node, 6, lane])
    return largest


@kernel
def _lowest_owner(points: Float, owner: Any, boxes: Float, groups: Float, largest: Any) -> int:
    """The lowest point index among all points whose running distance equals `largest`."""
    lowest = np.iinfo(np.int32).max
    for group in range(groups.shape[0]):
        for group_lane in range(FANOUT):
            if groups[group, 6, group_lane] != largest:
                continue
            block = group * FANOUT + group_lane
            for lane in range(FANOUT):
                if boxes[block, 6, lane] != largest:
                    continue
                bucket = block * FANOUT + lane
                for slot in range(BUCKET):
                    if points[bucket, 3, slot] == largest:
                        lowest = min(lowest, owner[bucket, slot])
    return lowest


@kernel
def _sample(xyz: Float, out: Any) -> None:
    points, owner, boxes, groups = build(xyz, _FARTHEST)
    near_blocks, near_buckets = np.empty(FANOUT, np.uint8), np.empty(FANOUT, np.uint8)
    chosen = 0
    for k in range(out.size):
        out[k] = chosen
        x, y, z = xyz[chosen, 0], xyz[chosen, 1], xyz[chosen, 2]
        largest = np.float32(-1)
        for group in range(groups.shape[0]):
            mark_near(groups, group, x, y, z, near_blocks)
            for group_lane in range(FANOUT):
                if not near_blocks[group_lane]:
                    continue
                block = group * FANOUT + group_lane
                mark_near(boxes, block, x, y, z, near_buckets)
                for lane in range(FANOUT):
                    if near_buckets[lane]:
                        boxes[block, 6, lane] = _update_bucket(points, block * FANOUT + lane, x, y, z)
                groups[group, 6, group_lane] = _largest_of(boxes, block)
            largest = max(largest, _largest_of(groups, group))
        if largest == 0:  # every distinct point is taken; the plain loop returns index 0 from here on
            out[k + 1 :] = 0
            return
        chosen = _lowest_owner(points, owner, boxes, groups, largest)


@kernel
def sample(xyz: Float, out: NDArray[np.int64]) -> None:
    """Write furthest point samples of xyz (B, N, 3), N >= 1, into out (B, npoint), each beginning with index 0."""
    for batch in range(xyz.shape[0]):
        _sample(xyz[batch], out[batch])
