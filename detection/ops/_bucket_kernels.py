"""Furthest points, ball query and three nearest neighbours with numba, on points cut into small boxes.

Points are sorted along a Morton curve and cut into buckets of 32; sixteen buckets make a block, sixteen blocks a group.
Each bucket and block knows its bounding box and its reach: the squared distance below which a place is of interest to
it. The distance from a place to a box is computed with the same float32 operations as the distance to a point, and
rounding is monotone, so it is a lower bound to the last bit: skipping a box never changes a result.

One file, because numba renews a compiled kernel when its own file changes, but not when that of a callee does.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from detection.ops._numba import kernel

Float = NDArray[np.float32]

_BUCKET = 32  # points
_FANOUT = 16  # buckets in a block, blocks in a group
_MORTON_BITS = 10  # per axis
# Times a power of two, this de Bruijn number shows another pattern in its top six bits for each of the 64.
_DE_BRUIJN = np.uint64(0x03F79D71B4CB0A89)
_BIT_OF = np.zeros(64, np.int64)
_BIT_OF[[((0x03F79D71B4CB0A89 << bit) % (1 << 64)) >> 58 for bit in range(64)]] = np.arange(64)
_FARTHEST = np.float32(1e10)  # where the running squared distances of sampling start, as in the reference kernel


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
def _morton_order(xyz: Float) -> Any:
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
        bucket, lane = slot // _BUCKET, slot % _BUCKET
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
        block, lane = bucket // _FANOUT, bucket % _FANOUT
        group, group_lane = block // _FANOUT, block % _FANOUT
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
def _build(xyz: Float, reach: Any) -> Any:
    """Buckets of xyz (N, 3) float32, N >= 1, where every point has the same reach (m^2).

    Returns points (buckets, 4, 32), owner (buckets, 32) int32, boxes (blocks, 7, 16), groups (groups, 7, 16); children
    are consecutive: bucket = block * 16 + lane, block = group * 16 + lane.
    """
    buckets = (xyz.shape[0] + _BUCKET - 1) // _BUCKET
    blocks = (buckets + _FANOUT - 1) // _FANOUT
    points = np.empty((buckets, 4, _BUCKET), np.float32)
    owner = np.empty((buckets, _BUCKET), np.int32)
    boxes = np.empty((blocks, 7, _FANOUT), np.float32)
    groups = np.empty(((blocks + _FANOUT - 1) // _FANOUT, 7, _FANOUT), np.float32)
    _fill_buckets(xyz, _morton_order(xyz), reach, points, owner)
    _fill_boxes(points, reach, boxes, groups)
    return points, owner, boxes, groups


@kernel
def _mark_near(boxes: Float, node: int, x: Any, y: Any, z: Any, near: Any) -> None:
    """near (16,) uint8: which children of `node` have x y z within their reach (squared distance below it)."""
    zero = np.float32(0)
    for lane in range(_FANOUT):
        dx = max(boxes[node, 0, lane] - x, x - boxes[node, 3, lane])
        dy = max(boxes[node, 1, lane] - y, y - boxes[node, 4, lane])
        dz = max(boxes[node, 2, lane] - z, z - boxes[node, 5, lane])
        dx, dy, dz = max(dx, zero), max(dy, zero), max(dz, zero)
        near[lane] = (dx * dx + dy * dy) + dz * dz < boxes[node, 6, lane]


@kernel
def _update_bucket(points: Float, bucket: int, x: Any, y: Any, z: Any) -> Any:
    """Shorten the running distances of one bucket by a sample at x y z; returns the largest that remains."""
    largest = np.float32(-1)
    for lane in range(_BUCKET):
        dx, dy, dz = points[bucket, 0, lane] - x, points[bucket, 1, lane] - y, points[bucket, 2, lane] - z
        distance = min((dx * dx + dy * dy) + dz * dz, points[bucket, 3, lane])
        points[bucket, 3, lane] = distance
        largest = max(largest, distance)
    return largest


@kernel
def _largest_of(boxes: Float, node: int) -> Any:
    largest = np.float32(-1)
    for lane in range(_FANOUT):
        largest = max(largest, boxes[node, 6, lane])
    return largest


@kernel
def _lowest_owner(points: Float, owner: Any, boxes: Float, groups: Float, largest: Any) -> int:
    """The lowest point index among all points whose running distance equals `largest`."""
    lowest = np.iinfo(np.int32).max
    for group in range(groups.shape[0]):
        for group_lane in range(_FANOUT):
            if groups[group, 6, group_lane] != largest:
                continue
            block = group * _FANOUT + group_lane
            for lane in range(_FANOUT):
                if boxes[block, 6, lane] != largest:
                    continue
                bucket = block * _FANOUT + lane
                for slot in range(_BUCKET):
                    if points[bucket, 3, slot] == largest:
                        lowest = min(lowest, owner[bucket, slot])
    return lowest


@kernel
def _sample(xyz: Float, out: Any) -> None:
    """Furthest points of one cloud. A sample can only change a bucket whose box is nearer than the bucket's reach, its
    largest remaining distance; almost all are skipped (the idea of QuickFPS, Han et al., IEEE TCAD 2023).
    """
    points, owner, boxes, groups = _build(xyz, _FARTHEST)
    near_blocks, near_buckets = np.empty(_FANOUT, np.uint8), np.empty(_FANOUT, np.uint8)
    chosen = 0
    for k in range(out.size):
        out[k] = chosen
        x, y, z = xyz[chosen, 0], xyz[chosen, 1], xyz[chosen, 2]
        largest = np.float32(-1)
        for group in range(groups.shape[0]):
            _mark_near(groups, group, x, y, z, near_blocks)
            for group_lane in range(_FANOUT):
                if not near_blocks[group_lane]:
                    continue
                block = group * _FANOUT + group_lane
                _mark_near(boxes, block, x, y, z, near_buckets)
                for lane in range(_FANOUT):
                    if near_buckets[lane]:
                        boxes[block, 6, lane] = _update_bucket(points, block * _FANOUT + lane, x, y, z)
                groups[group, 6, group_lane] = _largest_of(boxes, block)
            largest = max(largest, _largest_of(groups, group))
        if largest == 0:  # every distinct point is taken; the plain loop returns index 0 from here on
            out[k + 1 :] = 0
            return
        chosen = _lowest_owner(points, owner, boxes, groups, largest)


@kernel
def furthest_point_sample(xyz: Float, out: NDArray[np.int64]) -> None:
    """Write furthest point samples of xyz (B, N, 3), N >= 1, into out (B, npoint), each beginning with index 0."""
    for batch in range(xyz.shape[0]):
        _sample(xyz[batch], out[batch])


@kernel
def _lowest_bits(words: Any, kept: Any) -> int:
    """Positions of the lowest bits set in words (W,) uint64, ascending, into `kept` until full; clears all words."""
    count = 0
    for k in range(words.size):
        word = words[k]
        while word != 0 and count < kept.size:
            lowest = word & (~word + np.uint64(1))
            kept[count] = 64 * k + _BIT_OF[(lowest * _DE_BRUIJN) >> np.uint64(58)]
            count += 1
            word ^= lowest
        if count == kept.size:
            break
    words[:] = 0
    return count


@kernel
def _mark_points(points: Float, bucket: int, point: Float, limit: Any, near: Any) -> int:
    """near (32,) uint8: which points of a bucket have squared distance <= limit; returns how many."""
    x, y, z = point[0], point[1], point[2]
    found: Any = 0
    for lane in range(_BUCKET):
        dx, dy, dz = points[bucket, 0, lane] - x, points[bucket, 1, lane] - y, points[bucket, 2, lane] - z
        hit = np.uint8(((dx * dx + dy * dy) + dz * dz <= limit) & (points[bucket, 3, lane] >= 0))
        near[lane] = hit
        found += hit
    return found


@kernel
def _mark_within(boxes: Float, node: int, point: Float, limit: Any, near: Any) -> None:
    """near (16,) uint8: which children of `node` may hold a point with squared distance <= limit."""
    x, y, z, zero = point[0], point[1], point[2], np.float32(0)
    for lane in range(_FANOUT):
        dx = max(max(boxes[node, 0, lane] - x, x - boxes[node, 3, lane]), zero)
        dy = max(max(boxes[node, 1, lane] - y, y - boxes[node, 4, lane]), zero)
        dz = max(max(boxes[node, 2, lane] - z, z - boxes[node, 5, lane]), zero)
        near[lane] = ((dx * dx + dy * dy) + dz * dz <= limit) & (boxes[node, 6, lane] >= 0)


@kernel
def _mark_hits(tree: Any, centre: Float, limit: Any, near: Any, hits: Any) -> None:
    """Set the bit of every point with squared distance <= limit in hits (W,) uint64; near (3, 32) is working space."""
    points, owner, boxes, groups = tree
    for group in range(groups.shape[0]):
        _mark_within(groups, group, centre, limit, near[0])
        for group_lane in range(_FANOUT):
            if not near[0, group_lane]:
                continue
            block = group * _FANOUT + group_lane
            _mark_within(boxes, block, centre, limit, near[1])
            for lane in range(_FANOUT):
                bucket = block * _FANOUT + lane
                if near[1, lane] and _mark_points(points, bucket, centre, limit, near[2]):
                    for slot in range(_BUCKET):
                        if near[2, slot]:
                            index = np.uint64(owner[bucket, slot])
                            hits[index >> np.uint64(6)] |= np.uint64(1) << (index & np.uint64(63))


@kernel
def ball_query(xyz: Float, centres: Float, radius2: Any, out: Any) -> None:
    """out (B, P, S) int64: the S lowest indices of xyz (B, N, 3) nearer than the radius to centres (B, P, 3).

    Missing neighbours repeat the lowest; a ball without points gets index 0.
    """
    # "Below the radius" is "at most the float32 number before it".
    limit = np.nextafter(radius2, np.float32(0))
    near = np.empty((3, _BUCKET), np.uint8)
    hits = np.zeros((xyz.shape[1] + 63) // 64, np.uint64)
    for batch in range(xyz.shape[0]):
        tree = _build(xyz[batch], radius2)
        for p in range(centres.shape[1]):
            _mark_hits(tree, centres[batch, p], limit, near, hits)
            count = _lowest_bits(hits, out[batch, p])
            out[batch, p, count:] = out[batch, p, 0] if count else 0


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
        for group_lane in range(_FANOUT):
            if not near[0, group_lane]:
                continue
            block = group * _FANOUT + group_lane
            _mark_within(boxes, block, point, min(limit, best[2]), near[1])
            for lane in range(_FANOUT):
                bucket = block * _FANOUT + lane
                if near[1, lane] and _mark_points(points, bucket, point, min(limit, best[2]), near[2]):
                    for slot in range(_BUCKET):
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
    near = np.empty((3, _BUCKET), np.uint8)
    for batch in range(unknown.shape[0]):
        tree = _build(known[batch], infinite)
        last = -1
        for n in _morton_order(unknown[batch]):
            point, limit = unknown[batch, n], infinite
            if last >= 0 and known.shape[1] >= 3:
                limit = _third_distance(known[batch], index[batch, last], point)
            _three_nearest(tree, point, limit, near, distance[batch, n], index[batch, n])
            last = n
