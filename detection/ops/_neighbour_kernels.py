"""Ball query and three nearest neighbours with numba, in float32 with explicit differences as the reference kernels."""

from __future__ import annotations

from typing import Any

import numpy as np

from detection.ops._buckets import BUCKET, FANOUT, Float, build, morton_order
from detection.ops._numba import kernel


@kernel
def _keep_lowest(kept: Any, count: int, index: int) -> int:
    """Insert `index` into the ascending list kept[:count], dropping the largest when full; returns the new count."""
    if count == kept.size:
        if index >= kept[count - 1]:
            return count
        count -= 1
    slot = count
    while slot > 0 and kept[slot - 1] > index:
        kept[slot] = kept[slot - 1]
        slot -= 1
    kept[slot] = index
    return count + 1


@kernel
def _mark_points(points: Float, bucket: int, point: Float, limit: Any, near: Any) -> int:
    """near (32,) uint8: which points of a bucket have squared distance <= limit; returns how many."""
    x, y, z = point[0], point[1], point[2]
    found: Any = 0
    for lane in range(BUCKET):
        dx, dy, dz = points[bucket, 0, lane] - x, points[bucket, 1, lane] - y, points[bucket, 2, lane] - z
        hit = np.uint8(((dx * dx + dy * dy) + dz * dz <= limit) & (points[bucket, 3, lane] >= 0))
        near[lane] = hit
        found += hit
    return found


@kernel
def _mark_within(boxes: Float, node: int, point: Float, limit: Any, near: Any) -> None:
    """near (16,) uint8: which children of `node` may hold a point with squared distance <= limit."""
    x, y, z, zero = point[0], point[1], point[2], np.float32(0)
    for lane in range(FANOUT):
        dx = max(max(boxes[node, 0, lane] - x, x - boxes[node, 3, lane]), zero)
        dy = max(max(boxes[node, 1, lane] - y, y - boxes[node, 4, lane]), zero)
        dz = max(max(boxes[node, 2, lane] - z, z - boxes[node, 5, lane]), zero)
        near[lane] = ((dx * dx + dy * dy) + dz * dz <= limit) & (boxes[node, 6, lane] >= 0)


@kernel
def _lowest_within(tree: Any, centre: Float, limit: Any, near: Any, kept: Any) -> int:
    """Fill `kept` with the lowest indices of points with squared distance <= limit, ascending; returns how many.

    near (3, 32) uint8 is working space.
    """
    points, owner, boxes, groups = tree
    count = 0
    for group in range(groups.shape[0]):
        _mark_within(groups, group, centre, limit, near[0])
        for group_lane in range(FANOUT):
            if not near[0, group_lane]:
                continue
            block = group * FANOUT + group_lane
            _mark_within(boxes, block, centre, limit, near[1])
            for lane in range(FANOUT):
                bucket = block * FANOUT + lane
                if near[1, lane] and _mark_points(points, bucket, centre, limit, near[2]):
                    for slot in range(BUCKET):
                        if near[2, slot]:
                            count = _keep_lowest(kept, count, owner[bucket, slot])
    return count


@kernel
def ball_query(xyz: Float, centres: Float, radius2: Any, out: Any) -> None:
    """out (B, P, S) int64: the S lowest indices of xyz (B, N, 3) nearer than the radius to centres (B, P, 3).

    Missing neighbours repeat the lowest; a ball without points gets index 0.
    """
    # "Below the radius" is "at most the float32 number before it".
    limit = np.nextafter(radius2, np.float32(0))
    kept, near = np.empty(out.shape[2], np.int64), np.empty((3, BUCKET), np.uint8)
    for batch in range(xyz.shape[0]):
        tree = build(xyz[batch], radius2)
        for p in range(centres.shape[1]):
            count = _lowest_within(tree, centres[batch, p], limit, near, kept)
            out[batch, p, :count] = kept[:count]
            out[batch, p, count:] = kept[0] if count else 0


@kernel
def _insert(distance: Any, candidate: int, best: Float, index: Any) -> None:
    """Merge one point into best (3,), index (3,), which are ordered by distance, then by index."""
    slot = 3
    while slot > 0 and (distance < best[slot - 1] or (distance == best[slot - 1] and candidate < index[slot - 1])):
        slot -= 1
        if slot < 2:
            best[slot + 1], index[slot + 1] = best[slot], index[slot]
        best[slot], index[slot] = distance, candidate


@kernel
def _squared_distance(points: Float, bucket: int, slot: int, point: Float) -> Any:
    dx, dy = points[bucket, 0, slot] - point[0], points[bucket, 1, slot] - point[1]
    dz = points[bucket, 2, slot] - point[2]
    return (dx * dx + dy * dy) + dz * dz


@kernel
def _third_distance(known: Float, index: Any, point: Float) -> Any:
    """Largest squared distance from `point` to the three known points at `index`."""
    largest = np.float32(0)
    for k in range(3):
        dx, dy, dz = known[index[k], 0] - point[0], known[index[k], 1] - point[1], known[index[k], 2] - point[2]
        largest = max(largest, (dx * dx + dy * dy) + dz * dz)
    return largest


@kernel
def _three_nearest(tree: Any, point: Float, limit: Any, near: Any, best: Float, index: Any) -> None:
    """The three nearest within `limit`; near (3, 32) uint8 is working space."""
    points, owner, boxes, groups = tree
    for group in range(groups.shape[0]):
        _mark_within(groups, group, point, min(limit, best[2]), near[0])
        for group_lane in range(FANOUT):
            if not near[0, group_lane]:
                continue
            block = group * FANOUT + group_lane
            _mark_within(boxes, block, point, min(limit, best[2]), near[1])
            for lane in range(FANOUT):
                bucket = block * FANOUT + lane
                if near[1, lane] and _mark_points(points, bucket, point, min(limit, best[2]), near[2]):
                    for slot in range(BUCKET):
                        if near[2, slot]:
                            _insert(_squared_distance(points, bucket, slot, point), owner[bucket, slot], best, index)


@kernel
def three_nn(unknown: Float, known: Float, distance: Float, index: Any) -> None:
    """Squared distances (B, N, 3) and indices of the three known (B, M, 3) nearest to each unknown (B, N, 3).

    With fewer than three known points the rest is at infinite distance with index 0. Unknown points are visited along
    a Morton curve: the last one's neighbours bound the distance to the next one's.
    """
    infinite = np.float32(np.inf)
    distance[:] = infinite
    index[:] = 0
    near = np.empty((3, BUCKET), np.uint8)
    for batch in range(unknown.shape[0]):
        tree = build(known[batch], infinite)
        last = -1
        for n in morton_order(unknown[batch]):
            point, limit = unknown[batch, n], infinite
            if last >= 0 and known.shape[1] >= 3:
                limit = _third_distance(known[batch], index[batch, last], point)
            _three_nearest(tree, point, limit, near, distance[batch, n], index[batch, n])
            last = n
