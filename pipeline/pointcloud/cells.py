"""Cubic cells of a point cloud in an open-addressing hash table; shared by grid sampling and radius gathering.

A cell is floor(coordinate * (1 / size)) per axis, in float64. Its three numbers are packed into one int64 key
(21 bits each, so about a million cells either way). Cells are numbered in order of first appearance.

Points come block by block (some image rows, or a stretch of a cloud). Neighbours in an image mostly share a cell, so a
block is first cut into runs of one cell, without branches, and the table is asked once per run.

All kernels that use the table are in this file: numba's cache notices a change of the file a kernel stands in, but not
of another file whose functions were compiled into it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

# 21 bits per axis; larger clouds or smaller cells are refused rather than wrapped around.
CELL_LIMIT = 1 << 20
_BLOCK = 16_384
_LARGEST_FIRST_CAPACITY = 1 << 17
# The radius in cells: just under half a cell, so that rounding can never push a neighbour into a third cell.
_REACH = 0.5 * (1 - 1e-6)


@dataclass(frozen=True)
class Cells:
    """The occupied cells of N points and the runs of consecutive points in one cell.

    run_start  (R + 1,) int32 first point of every run; the last entry is N
    run_cell   (R,) int32 cell number of every run; -1 for points that are left out
    keys       (M,) int64 packed key of every cell
    table      (capacity,) int32 cell number at each slot or -1; a key is found by linear probing from its slot
    """

    run_start: NDArray[np.int32]
    run_cell: NDArray[np.int32]
    keys: NDArray[np.int64]
    table: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.keys)


def occupied_cells(points: NDArray[np.float32], inverse_size: float, what: str) -> Cells:
    """Cells of (N, 3 or more) float32 points for cells of 1 / `inverse_size` metres.

    Raises ValueError, beginning with `what`, for other arrays, NaN, infinity, and coordinates beyond CELL_LIMIT cells.
    """
    if points.ndim != 2 or points.shape[1] < 3 or points.dtype != np.float32:
        raise ValueError(f"{what}: expected (N, 3 or more) float32 points, got {points.shape} {points.dtype}")
    builder, kept = CellBuilder(inverse_size, what), np.ones(len(points), np.bool_)
    for first in range(0, len(points), _BLOCK):
        block = np.ascontiguousarray(points[first : first + _BLOCK, :3].T)
        builder.check(float(np.abs(block).max()))
        builder.add(block, first, kept)
    return builder.cells()


class CellBuilder:
    """Numbers the cells of points that come block by block."""

    def __init__(self, inverse_size: float, what: str) -> None:
        self.inverse_size, self.what = inverse_size, what
        self.block_runs: list[tuple[int, int]] = []
        self._run_key: list[NDArray[np.int64]] = []
        self._run_end: list[NDArray[np.int32]] = []
        # Room for the keys of a block, used again by the next.
        self._scratch = np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.int32)

    def add(self, block: NDArray[np.float32], first: int, kept: NDArray[np.bool_]) -> None:
        """Take the next (3, n) block, whose points are `first` and the following.

        Points that `kept` (of all points) does not mark are left out. The caller has checked the block's reach.
        """
        width = block.shape[1]
        if len(self._scratch[0]) <= width:
            self._scratch = np.empty(width + 1, np.int64), np.empty(width, np.int64), np.empty(width, np.int32)
        keys, run_key, run_end = self._scratch
        runs = _cut_into_runs(block, kept[first : first + width], first, self.inverse_size, keys, run_key, run_end)
        begin = self.block_runs[-1][1] if self.block_runs else 0
        self.block_runs.append((begin, begin + runs))
        self._run_key.append(run_key[:runs].copy())
        self._run_end.append(run_end[:runs].copy())

    def check(self, reach: float) -> None:
        """Raise ValueError when a coordinate of this absolute value has no cell; NaN has none."""
        if reach * self.inverse_size < CELL_LIMIT:
            return
        if not np.isfinite(reach):
            raise ValueError(f"{self.what}: the points hold NaN or infinite values; drop them first")
        size = 1 / self.inverse_size
        raise ValueError(
            f"{self.what}: a point lies more than {CELL_LIMIT * size:g} m from the origin, too far for cells of "
            f"{size:g} m; are the coordinates metres in the LiDAR frame?"
        )

    def cells(self) -> Cells:
        """All cells. The blocks' runs are numbered in one go, while the table stays in the cache."""
        run_start = np.concatenate([np.zeros(1, np.int32), *self._run_end])
        run_key = np.concatenate([np.empty(0, np.int64), *self._run_key])
        run_cell = np.empty(len(run_key), np.int32)
        # Sized for the cells, not for the runs; it grows when half full.
        capacity = 1 << 10
        while capacity < min(len(run_key), _LARGEST_FIRST_CAPACITY):
            capacity *= 2
        table, keys = np.full(capacity, -1, np.int32), np.empty(capacity // 2, np.int64)
        done, count = _number(run_key, run_cell, table, keys, 0, 0)
        while done < len(run_key):
            capacity *= 4
            table, keys = (
                np.full(capacity, -1, np.int32),
                np.concatenate([keys, np.empty(capacity // 2 - count, np.int64)]),
            )
            _refill(table, keys, count)
            done, count = _number(run_key, run_cell, table, keys, done, count)
        return Cells(run_start, run_cell, keys[:count], table)


def mark_near(
    points: NDArray[np.float32],
    group: NDArray[np.bool_],
    anchors: NDArray[np.float32],
    radius: float,
    marked: NDArray[np.bool_],
) -> None:
    """Set `marked` for the points of `group` that have an anchor within `radius`, inclusive.

    Cells are twice the radius wide, so a point's neighbourhood touches at most eight of them.
    """
    inverse_size = _REACH / radius
    cells = occupied_cells(anchors, inverse_size, "radius gathering")
    starts = np.zeros(len(cells) + 1, np.int32)
    # One row per axis: a cell's anchors lie side by side, so that their distances are computed several at a time.
    members = np.empty((3, len(anchors)), np.float32)
    bounds = np.empty((len(cells), 6), np.float32)
    bounds[:, :3], bounds[:, 3:] = np.inf, -np.inf
    if not len(cells):
        return
    _sort_by_cell(anchors, cells.run_start, cells.run_cell, starts, members, bounds)
    _mark_near(points, group, members, bounds, starts, cells.table, cells.keys, inverse_size, radius**2, marked)


@njit(cache=True, nogil=True, inline="always")
def _pack(ix, iy, iz):  # type: ignore[no-untyped-def]
    """One int64 key of three cell numbers inside +-CELL_LIMIT."""
    return ((np.int64(ix) + CELL_LIMIT) << 42) | ((np.int64(iy) + CELL_LIMIT) << 21) | (np.int64(iz) + CELL_LIMIT)


# Indices are unsigned in the kernels below: numba looks whether a signed one is negative at every access.
@njit(cache=True, nogil=True, inline="always")
def _slot(key, capacity):  # type: ignore[no-untyped-def]
    """Where the search for a key begins. Multiplying spreads a key upwards, folding brings all of it down again."""
    product = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return (product ^ (product >> np.uint64(32)) ^ (product >> np.uint64(47))) & np.uint64(capacity - 1)


@njit(cache=True, nogil=True)
def _cut_into_runs(block, kept, first, inverse_size, keys, run_key, run_end):  # type: ignore[no-untyped-def]
    """Keys of a block's runs (-1: left out) and the points after their last; returns how many there are."""
    count, runs = block.shape[1], np.uint64(0)
    keys[count] = -2  # no point has this key, so the last run ends before it
    for i in range(count):
        x, y, z = block[0, i] * inverse_size, block[1, i] * inverse_size, block[2, i] * inverse_size
        key = _pack(np.int32(np.floor(x)), np.int32(np.floor(y)), np.int32(np.floor(z)))
        keys[i] = key | (np.int64(kept[i]) - 1)  # all bits set, so -1, when left out
    for i in range(count):
        # Written at every point; the place moves on only where the next key differs (no branches).
        run_key[runs] = keys[i]
        run_end[runs] = first + i + 1
        runs += np.uint64(keys[i] != keys[i + 1])
    return np.int64(runs)


@njit(cache=True, nogil=True)
def _number(run_key, run_cell, table, keys, start, count):  # type: ignore[no-untyped-def]
    """Number the cells from run `start` on; (runs done, cells so far). Stops when `keys` is full."""
    last = np.uint64(table.size - 1)
    for run in range(np.uint64(start), np.uint64(run_key.size)):
        key = run_key[run]
        if key < 0:
            run_cell[run] = -1
            continue
        at = _slot(key, table.size)
        cell = table[at]
        while (cell >= 0) & (keys[np.uint64(max(cell, 0))] != key):
            at = (at + np.uint64(1)) & last
            cell = table[at]
        if cell < 0:
            if count == keys.size:
                return np.int64(run), count
            cell = count
            table[at] = cell
            keys[np.uint64(count)] = key
            count += 1
        run_cell[run] = cell
    return run_key.size, count


@njit(cache=True, nogil=True)
def _refill(table, keys, count):  # type: ignore[no-untyped-def]
    for cell in range(count):
        at = _slot(keys[cell], table.size)
        while table[at] >= 0:
            at = (at + np.uint64(1)) & np.uint64(table.size - 1)
        table[at] = cell


@njit(cache=True, nogil=True)
def _sort_by_cell(anchors, run_start, run_cell, starts, members, bounds):  # type: ignore[no-untyped-def]
    """Counting sort: the anchors of cell c become members[:, starts[c] : starts[c + 1]], within bounds[c]."""
    for run in range(run_cell.size):
        starts[run_cell[run] + 1] += run_start[run + 1] - run_start[run]
    for cell in range(starts.size - 1):
        starts[cell + 1] += starts[cell]
    fill = starts[:-1].copy()
    for run in range(run_cell.size):
        cell = run_cell[run]
        at = fill[cell]
        for i in range(run_start[run], run_start[run + 1]):
            for axis in range(3):
                value = anchors[i, axis]
                members[axis, at] = value
                bounds[cell, axis] = min(bounds[cell, axis], value)
                bounds[cell, 3 + axis] = max(bounds[cell, 3 + axis], value)
            at += 1
        fill[cell] = at


@njit(cache=True, nogil=True, inline="always")
def _find(key, table, keys):  # type: ignore[no-untyped-def]
    """The number of the cell with this key, or -1."""
    at = _slot(key, table.size)
    cell = np.int64(table[at])
    while (cell >= 0) & (keys[np.uint64(max(cell, 0))] != key):
        at = (at + np.uint64(1)) & np.uint64(table.size - 1)
        cell = np.int64(table[at])
    return cell


@njit(cache=True, nogil=True, inline="always")
def _holds_near(cell, x, y, z, members, bounds, starts, limit):  # type: ignore[no-untyped-def]
    """True when a member of the cell lies within sqrt(limit) of x, y, z."""
    # Returns lie on surfaces, so a cell's bounds are thin and mostly settle the matter.
    bx = max(bounds[cell, 0] - x, x - bounds[cell, 3], 0.0)
    by = max(bounds[cell, 1] - y, y - bounds[cell, 4], 0.0)
    bz = max(bounds[cell, 2] - z, z - bounds[cell, 5], 0.0)
    near = 0
    if bx * bx + by * by + bz * bz <= limit:
        for j in range(np.uint64(starts[cell]), np.uint64(starts[cell + np.uint64(1)])):
            dx, dy, dz = x - members[0, j], y - members[1, j], z - members[2, j]
            near += np.int64(dx * dx + dy * dy + dz * dz <= limit)
    return near > 0


@njit(cache=True, nogil=True)
def _mark_near(  # type: ignore[no-untyped-def]
    points, group, members, bounds, starts, table, keys, inverse_size, limit, marked
):
    around = np.empty(7, np.int64)
    last_x, last_y, last_z, own_key, own, found = np.int64(1 << 40), np.int64(0), np.int64(0), np.int64(-1), -1, -1
    for i in range(points.shape[0]):
        if not group[i]:
            continue
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        # Half cells say both the cell and the side on which a second cell comes within reach.
        fx, fy, fz = 2 * x * inverse_size, 2 * y * inverse_size, 2 * z * inverse_size
        if not max(abs(fx), abs(fy), abs(fz)) < 2 * (CELL_LIMIT - 2):
            continue  # anchors are all within the limit, so none is near
        hx, hy, hz = np.int64(np.floor(fx)), np.int64(np.floor(fy)), np.int64(np.floor(fz))
        if hx != last_x or hy != last_y or hz != last_z:  # neighbours in the image mostly share their cells
            last_x, last_y, last_z, found = hx, hy, hz, -1
            key = _pack(hx >> 1, hy >> 1, hz >> 1)
            if key != own_key:
                own_key, own = key, _find(key, table, keys)
        # Most points have an anchor in their own cell; the seven others are looked up only for the rest.
        if own >= 0 and _holds_near(np.uint64(own), x, y, z, members, bounds, starts, limit):
            marked[i] = True
            continue
        if found < 0:
            found = 0
            sx, sy, sz = 2 * (hx & 1) - 1, 2 * (hy & 1) - 1, 2 * (hz & 1) - 1
            for corner in range(1, 8):
                key = _pack(
                    (hx >> 1) + (corner & 1) * sx,
                    (hy >> 1) + ((corner >> 1) & 1) * sy,
                    (hz >> 1) + (corner >> 2) * sz,
                )
                cell = _find(key, table, keys)
                around[found] = cell  # stays only when there is such a cell (no branch)
                found += np.int64(cell >= 0)
        for c in range(found):
            if _holds_near(np.uint64(around[c]), x, y, z, members, bounds, starts, limit):
                marked[i] = True
                break
