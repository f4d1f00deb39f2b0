"""Cubic cells of a point cloud in an open-addressing hash table; shared by grid sampling and radius gathering.

A cell is floor(coordinate * (1 / size)) per axis, in float64. Its three numbers are packed into one int64 key
(21 bits each, so about a million cells either way), and the table holds cell numbers given in order of first appearance.
"""

from __future__ import annotations

from math import floor

import numpy as np
from numba import njit

# 21 bits per axis; larger clouds or smaller cells are refused rather than wrapped around.
CELL_LIMIT = 1 << 20
NOT_FINITE = -1
TOO_FAR = -2
_FIRST_CAPACITY = 1 << 14


@njit(cache=True, nogil=True, inline="always")
def pack(ix, iy, iz):  # type: ignore[no-untyped-def]
    """One int64 key of three cell numbers inside +-CELL_LIMIT."""
    return ((np.int64(ix) + CELL_LIMIT) << 42) | ((np.int64(iy) + CELL_LIMIT) << 21) | (np.int64(iz) + CELL_LIMIT)


@njit(cache=True, nogil=True, inline="always")
def _slot(key, capacity):  # type: ignore[no-untyped-def]
    # Fibonacci hashing: the upper half of the product mixes all bits of the key.
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64(mixed >> np.uint64(32)) & (capacity - 1)


@njit(cache=True, nogil=True, inline="always")
def find(key, table, keys):  # type: ignore[no-untyped-def]
    """Cell number of a key, or -1."""
    capacity = table.size
    slot = _slot(key, capacity)
    while True:
        cell = table[slot]
        if cell < 0 or keys[cell] == key:
            return cell
        slot = (slot + 1) & (capacity - 1)


@njit(cache=True, nogil=True)
def _insert(key, cell, table):  # type: ignore[no-untyped-def]
    capacity = table.size
    slot = _slot(key, capacity)
    while table[slot] >= 0:
        slot = (slot + 1) & (capacity - 1)
    table[slot] = cell


@njit(cache=True, nogil=True)
def _rehashed(keys, count, capacity):  # type: ignore[no-untyped-def]
    table = np.full(capacity, -1, np.int32)
    for cell in range(count):
        _insert(keys[cell], cell, table)
    return table


@njit(cache=True, nogil=True)
def assign_cells(points, inverse_size, cell_of_point):  # type: ignore[no-untyped-def]
    """Fill `cell_of_point`; return (number of cells or a negative code, table, keys).

    Neighbours in the image mostly share a cell, so the previous point's cell is tried before the table.
    """
    table = np.full(_FIRST_CAPACITY, -1, np.int32)
    keys = np.empty(_FIRST_CAPACITY // 2, np.int64)
    count, last_key, last_cell = 0, np.int64(-1), -1
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] * inverse_size, points[i, 1] * inverse_size, points[i, 2] * inverse_size
        reach = max(abs(x), abs(y), abs(z))
        if not reach < CELL_LIMIT or x != x or y != y or z != z:
            finite = np.isfinite(points[i, 0]) and np.isfinite(points[i, 1]) and np.isfinite(points[i, 2])
            return (TOO_FAR if finite else NOT_FINITE), table, keys
        key = pack(floor(x), floor(y), floor(z))
        if key != last_key:
            last_key, last_cell = key, find(key, table, keys)
            if last_cell < 0:
                if count == keys.size:
                    grown = np.empty(2 * count, np.int64)
                    grown[:count] = keys
                    keys = grown
                    table = _rehashed(keys, count, 4 * count)
                last_cell = count
                keys[count] = key
                _insert(key, count, table)
                count += 1
        cell_of_point[i] = last_cell
    return count, table, keys


def refuse(code: int, what: str, size: float) -> None:
    """Raise the ValueError of a negative code of `assign_cells`; do nothing otherwise."""
    if code == NOT_FINITE:
        raise ValueError(f"{what}: the points hold NaN or infinite values; drop them first")
    if code == TOO_FAR:
        raise ValueError(
            f"{what}: a point lies more than {CELL_LIMIT * size:g} m from the origin, "
            f"too far for cells of {size:g} m; are the coordinates metres in the LiDAR frame?"
        )
