"""Values behind the pictures: coarse grids of a map's numbers, shown when a map is pointed at."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NOTHING = 65535


@dataclass(frozen=True)
class HoverGrid:
    """(rows, columns) uint16 values x `scale`, 65535 = none, row by row in base64."""

    columns: int
    rows: int
    scale: int
    unit: str
    data: str


def hover_step(frames: int) -> int:
    """Pixels between two values, by how many frames share the page."""
    return 4 if frames <= 6 else 6 if frames <= 12 else 8


def hover_grid(values: NDArray[np.float32], valid: NDArray[np.bool_], step: int, scale: int, unit: str) -> HoverGrid:
    """The value of the pixel in the middle of every step x step cell, or the smallest of the cell when that has none.

    values  (H, W); scale turns them into whole numbers (256 keeps depth as KITTI stores it)
    """
    height, width = values.shape
    rows, columns = -(-height // step), -(-width // step)
    whole = np.full((rows * step, columns * step), NOTHING, np.uint16)
    whole[:height, :width] = np.where(valid, np.rint(values * scale).clip(0, NOTHING - 1), NOTHING)
    cells = whole.reshape(rows, step, columns, step).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    middle = cells[:, :, (step // 2) * step + step // 2]
    # The smallest is the nearest surface, and a value wherever there is one.
    grid = np.where(middle != NOTHING, middle, cells.min(axis=2)).astype("<u2")
    return HoverGrid(columns, rows, scale, unit, base64.b64encode(grid.tobytes()).decode("ascii"))
