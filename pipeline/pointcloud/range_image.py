"""Resampling of a dense cloud in azimuth-elevation space, like a LiDAR of R rows (thesis Tables 5.5 and 5.7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from auglidar_base.errors import SettingsError


@dataclass(frozen=True)
class RangeGrid:
    """The beams: R rows from `top` downwards over `vertical` degrees, and columns over `horizontal` degrees ahead.

    rows        R, 64 to 512 in the thesis; the step is vertical / R (0.4 degrees at 64)
    az_steps    columns; 512 is customary for pseudo-LiDAR (Wang et al. 2019), a real scanner at 10 Hz has about 520
    top         elevation of the first row in degrees
    vertical    degrees from the first to the last row
    horizontal  degrees, half to the left and half to the right of x
    origin      metres, where the scanner stands in the frame of the points
    """

    rows: int = 64
    az_steps: int = 512
    top: float = 2.0
    vertical: float = 25.6
    horizontal: float = 90.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.rows < 1 or self.az_steps < 1 or not (self.vertical > 0 and 0 < self.horizontal <= 360):
            raise SettingsError(f"range image: expected positive numbers of rows, columns and degrees, got {self}")
        if len(self.origin) != 3:
            raise SettingsError(f"range image: expected an origin x y z, got {self.origin}")


def range_cells(points: NDArray[np.float32], grid: RangeGrid) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(N, 3) points -> (N,) row * az_steps + column, -1 outside the grid, and (N,) range in metres.

    Elevation asin(z / range), azimuth asin(y / sqrt(x^2 + y^2)) as pseudo-LiDAR has it, which folds the space behind
    the scanner onto the one ahead; here points behind are outside instead. Points outside are dropped, not clamped
    into the border cells.

    Raises ValueError for NaN or infinite values.
    """
    if not np.isfinite(points).all():
        raise ValueError("range image: the points hold NaN or infinite values; drop them first")
    x, y, z = (points[:, :3].astype(np.float64) - np.asarray(grid.origin)).T
    distance = np.sqrt(x * x + y * y + z * z)
    elevation = np.degrees(np.arctan2(z, np.sqrt(x * x + y * y)))
    azimuth = np.degrees(np.arctan2(y, x))
    row = np.floor((grid.top - elevation) * (grid.rows / grid.vertical))
    column = np.floor((grid.horizontal / 2 - azimuth) * (grid.az_steps / grid.horizontal))
    inside = (row >= 0) & (row < grid.rows) & (column >= 0) & (column < grid.az_steps) & (distance > 0)
    return np.where(inside, row * grid.az_steps + column, -1).astype(np.int64), distance


def range_sample(points: NDArray[np.float32], grid: RangeGrid) -> NDArray[np.int64]:
    """(N, 3) points -> ascending indices of the nearest point of every cell; of equally near ones the first.

    Points are picked, never moved, so a sparse map made from them agrees with the dense one at every pixel it has.
    """
    cells, distance = range_cells(points, grid)
    chosen = np.full(grid.rows * grid.az_steps, -1, np.int64)
    _nearest_per_cell(cells, distance, chosen)
    return np.sort(chosen[chosen >= 0])


@njit(cache=True, nogil=True)
def _nearest_per_cell(cells, distance, chosen):  # type: ignore[no-untyped-def]
    for i in range(cells.size):
        cell = cells[i]
        if cell >= 0 and (chosen[cell] < 0 or distance[i] < distance[chosen[cell]]):
            chosen[cell] = i
