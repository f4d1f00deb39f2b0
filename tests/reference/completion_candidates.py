"""Candidates of one pixel by walking up and down a column."""

from __future__ import annotations

import math

import numpy as np


def filled_column(sparse: np.ndarray, column: int) -> list[float]:
    """A column where an empty pixel takes the nearer of its left and right neighbours."""
    height, width = sparse.shape
    values = []
    for row in range(height):
        if sparse[row, column] > 0:
            values.append(float(sparse[row, column]))
            continue
        sides = [float(sparse[row, c]) for c in (column - 1, column + 1) if 0 <= c < width and sparse[row, c] > 0]
        values.append(min(sides) if sides else 0.0)
    return values


def walk(column: list[float], row: int, step: int) -> tuple[float, int] | None:
    """Depth and distance of the first sample from `row` in direction `step`, the row itself included."""
    distance = 0
    while 0 <= row < len(column):
        if column[row] > 0:
            return column[row], distance
        row, distance = row + step, distance + 1
    return None


def up_and_down(sparse: np.ndarray, row: int, column: int) -> list[tuple[float, float] | None]:
    """(log depth, -log(distance + 0.5)) of the sample above and below, None where there is none."""
    values = filled_column(sparse, column)
    found = [walk(values, row, -1), walk(values, row, 1)]
    return [None if f is None else (math.log(f[0]), -math.log(f[1] + 0.5)) for f in found]
