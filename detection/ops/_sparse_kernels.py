"""Numba kernels of the sparse convolution: a hash table of voxels, and the pairs a convolution connects.

A voxel (b, z, y, x) has the key ((b * Z + z) * Y + y) * X + x. Tables use open addressing: `table_keys` holds keys or
-1, `table_rows` the row of each key; their length is a power of two of at least twice the number of keys.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from detection.ops._numba import kernel

Integers = NDArray[np.int64]


@kernel
def _place(table_keys: Integers, key: int) -> int:
    """Where `key` is in the table, or the free place where it would go."""
    mask = table_keys.size - 1
    place = ((key * 2654435761) >> 16) & mask
    while table_keys[place] != key and table_keys[place] != -1:
        place = (place + 1) & mask
    return place


@kernel
def fill_table(keys: Integers, table_keys: Integers, table_rows: Integers) -> None:
    """Enter keys (N,) with their rows 0 ... N-1 into a table whose keys are all -1."""
    for row in range(keys.size):
        place = _place(table_keys, keys[row])
        table_keys[place] = keys[row]
        table_rows[place] = row


@kernel
def neighbour_pairs(
    coords: Integers,
    shape: Integers,
    offsets: Integers,
    table_keys: Integers,
    table_rows: Integers,
    source: Integers,
    target: Integers,
    counts: Integers,
) -> int:
    """For every offset (K, 3) z y x the pairs (row of coords + offset, row of coords), targets ascending.

    coords (N, 4) b z y x. Pairs go to `source` and `target` one offset after the other; counts (K,) gets their numbers.
    """
    total = 0
    for k in range(offsets.shape[0]):
        before = total
        for row in range(coords.shape[0]):
            z = coords[row, 1] + offsets[k, 0]
            y = coords[row, 2] + offsets[k, 1]
            x = coords[row, 3] + offsets[k, 2]
            if z < 0 or z >= shape[0] or y < 0 or y >= shape[1] or x < 0 or x >= shape[2]:
                continue
            place = _place(table_keys, ((coords[row, 0] * shape[0] + z) * shape[1] + y) * shape[2] + x)
            if table_keys[place] != -1:
                source[total] = table_rows[place]
                target[total] = row
                total += 1
        counts[k] = total - before
    return total


@kernel
def window_pairs(
    coords: Integers,
    taps: Integers,
    stride: Integers,
    padding: Integers,
    out_shape: Integers,
    table_keys: Integers,
    table_rows: Integers,
    out_keys: Integers,
    source: Integers,
    target: Integers,
    counts: Integers,
) -> tuple[int, int]:
    """Pairs (input row, output row) of a strided convolution, one tap (K, 3) z y x after the other.

    Outputs are numbered in the order they are met; out_keys gets their keys. Returns numbers of pairs and of outputs.
    """
    total, outputs = 0, 0
    for k in range(taps.shape[0]):
        before = total
        for row in range(coords.shape[0]):
            z = coords[row, 1] + padding[0] - taps[k, 0]
            y = coords[row, 2] + padding[1] - taps[k, 1]
            x = coords[row, 3] + padding[2] - taps[k, 2]
            if z < 0 or y < 0 or x < 0 or z % stride[0] != 0 or y % stride[1] != 0 or x % stride[2] != 0:
                continue
            z, y, x = z // stride[0], y // stride[1], x // stride[2]
            if z >= out_shape[0] or y >= out_shape[1] or x >= out_shape[2]:
                continue
            key = ((coords[row, 0] * out_shape[0] + z) * out_shape[1] + y) * out_shape[2] + x
            place = _place(table_keys, key)
            if table_keys[place] == -1:
                table_keys[place] = key
                table_rows[place] = outputs
                out_keys[outputs] = key
                outputs += 1
            source[total] = row
            target[total] = table_rows[place]
            total += 1
        counts[k] = total - before
    return total, outputs


@kernel
def add_rows(out: Any, index: Integers, rows: Any) -> None:
    """out[index[r]] += rows[r] for (R, C) rows."""
    for r in range(rows.shape[0]):
        place = index[r]
        for c in range(rows.shape[1]):
            out[place, c] += rows[r, c]


@kernel
def voxel_query(
    centres: Any,
    coords: Integers,
    shape: Integers,
    reach: Integers,
    low: Any,
    size: Any,
    radius2: float,
    table_keys: Integers,
    table_rows: Integers,
    found: Integers,
) -> None:
    """The first active voxels within `reach` (z y x) of coords (M, 4) b z y x whose centre is within the radius.

    centres (M, 3) x y z float32; voxel centres are low + (index + 0.5) * size, float32. Scan order z, y, x; the rest of
    found (M, S) repeats the first; without any it is -1.
    """
    half = np.float32(0.5)
    for m in range(centres.shape[0]):
        count = 0
        for z in range(max(coords[m, 1] - reach[0], 0), min(coords[m, 1] + reach[0] + 1, shape[0])):
            dz = (np.float32(z) + half) * size[2] + low[2] - centres[m, 2]
            for y in range(max(coords[m, 2] - reach[1], 0), min(coords[m, 2] + reach[1] + 1, shape[1])):
                dy = (np.float32(y) + half) * size[1] + low[1] - centres[m, 1]
                if count == found.shape[1]:
                    break
                for x in range(max(coords[m, 3] - reach[2], 0), min(coords[m, 3] + reach[2] + 1, shape[2])):
                    dx = (np.float32(x) + half) * size[0] + low[0] - centres[m, 0]
                    if dx * dx + dy * dy + dz * dz > radius2:
                        continue
                    place = _place(table_keys, ((coords[m, 0] * shape[0] + z) * shape[1] + y) * shape[2] + x)
                    if table_keys[place] == -1:
                        continue
                    found[m, count] = table_rows[place]
                    count += 1
                    if count == found.shape[1]:
                        break
        filler = found[m, 0] if count else -1
        for s in range(count, found.shape[1]):
            found[m, s] = filler
