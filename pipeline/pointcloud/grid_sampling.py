"""Grid sampling: one representative point per cubic cell (thesis 5.3.4.2, Table 5.5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from auglidar_base.errors import SettingsError
from pipeline.geometry.clouds import DenseCloud
from pipeline.pointcloud.cells import Cells, occupied_cells

Representative = Literal["nearest", "first", "centroid"]


@dataclass(frozen=True)
class GridSampling:
    """The grid.

    size            edge of a cell in metres (0.2 in thesis 5.3.4.2 and Fig. 5.7; 0.1 in Tables 5.5 and 5.7)
    representative  "nearest": the point nearest to the mean of its cell; "first": in row order; "centroid": the mean
    """

    size: float = 0.2
    representative: Representative = "nearest"

    def __post_init__(self) -> None:
        if not 0 < self.size < np.inf:
            raise SettingsError(f"grid sampling: expected a cell size > 0 m, got {self.size:g}")
        if self.representative not in ("nearest", "first", "centroid"):
            raise SettingsError(f"grid sampling: expected nearest, first or centroid, got {self.representative!r}")


def grid_sample(points: NDArray[np.float32], grid: GridSampling) -> NDArray[np.int64]:
    """(N, 3) points -> (M,) index of the representative of every occupied cell, in order of first appearance.

    A point lies in cell floor(coordinate * (1 / size)), computed in float64. The centroid is the float64 mean of the
    points rounded to 15 nm (see `settle`); of equally near points the first wins. For "centroid" the index is that of
    the first point, whose pixel the mean takes (see `grid_sampling`).

    Raises ValueError for NaN or infinite coordinates.
    """
    cells = occupied_cells(points, 1.0 / grid.size, "grid sampling")
    if grid.representative != "nearest":
        return first_of_cells(cells)
    columns, nearest = points[:, :3].T.copy(), np.zeros(len(cells), np.int32)
    settle(columns)
    centroids = _centroids(columns, cells)
    centroids[:, 3] = np.inf
    nearest_in_block(columns, 0, cells, (0, len(cells.run_cell)), centroids, nearest)
    return nearest.astype(np.int64)


def grid_sampling(cloud: DenseCloud, grid: GridSampling) -> DenseCloud:
    """The sampled cloud. With "centroid" the points are means and keep the pixel of their cell's first member."""
    if grid.representative != "centroid":
        return cloud.select(grid_sample(cloud.points, grid))
    cells = occupied_cells(cloud.points, 1.0 / grid.size, "grid sampling")
    columns = cloud.points.T.copy()
    settle(columns)
    centroids = _centroids(columns, cells)
    return DenseCloud(centroids[:, :3].astype(np.float32), cloud.pixels[first_of_cells(cells)])


def _centroids(columns: NDArray[np.float32], cells: Cells) -> NDArray[np.float64]:
    """(3, N) points -> (M, 4) centroid and number of members of every cell."""
    sums = np.zeros((len(cells), 4))
    add_block(columns, 0, cells, (0, len(cells.run_cell)), sums)
    sums[:, :3] /= sums[:, 3:]
    return sums


def first_of_cells(cells: Cells) -> NDArray[np.int64]:
    """(M,) index of the first point of every cell."""
    representatives = np.empty(len(cells), np.int64)
    _first(cells.run_start, cells.run_cell, representatives)
    return representatives


def settle(points: NDArray[np.float32]) -> None:
    """Round (3, n) points in place to multiples of 2^-26 m (15 nm).

    Only coordinates below 0.125 m change, by less than 8 nm; float32 is coarser elsewhere. Then sums of half a million
    coordinates below 128 m are exact in float64, so a centroid depends neither on the order of the points nor on how
    they are added up, and the two points of a cell are equally near to it.
    """
    _settle(points)


def add_block(
    points: NDArray[np.float32], first: int, cells: Cells, runs: tuple[int, int], sums: NDArray[np.float64]
) -> None:
    """Add a settled (3, n) block, whose points are numbered from `first`, to (M, 4) `sums` of x, y, z and count."""
    _add_block(points, first, cells.run_start, cells.run_cell, runs, sums)


def nearest_in_block(
    points: NDArray[np.float32],
    first: int,
    cells: Cells,
    runs: tuple[int, int],
    centroids: NDArray[np.float64],
    nearest: NDArray[np.int32],
) -> None:
    """Update (M,) `nearest`, the point nearest to each centroid; column 3 of `centroids` is its squared distance.

    Block and runs as in `add_block`. Of equally near points the first wins.
    """
    _nearest_in_block(points, first, cells.run_start, cells.run_cell, runs, centroids, nearest)


@njit(cache=True, nogil=True)
def _first(run_start, run_cell, representatives):  # type: ignore[no-untyped-def]
    seen = 0
    for run in range(run_cell.size):
        if run_cell[run] == seen:
            representatives[seen] = run_start[run]
            seen += 1


@njit(cache=True, nogil=True)
def _settle(points):  # type: ignore[no-untyped-def]
    for axis in range(points.shape[0]):
        for i in range(points.shape[1]):
            # Exact in float32: powers of two, and whole numbers below 2^23 where anything changes.
            points[axis, i] = np.rint(points[axis, i] * np.float32(1 << 26)) * np.float32(1.0 / (1 << 26))


@njit(cache=True, nogil=True)
def _add_block(points, first, run_start, run_cell, runs, sums):  # type: ignore[no-untyped-def]
    count = points.shape[1]
    # Sums up to each point: a run's sum is the difference at its ends, without a loop of unforeseeable length.
    upto = np.empty((count + 1, 4))
    x, y, z = 0.0, 0.0, 0.0
    for i in range(count):
        upto[i, 0], upto[i, 1], upto[i, 2], upto[i, 3] = x, y, z, i
        x += points[0, i]
        y += points[1, i]
        z += points[2, i]
    upto[count, 0], upto[count, 1], upto[count, 2], upto[count, 3] = x, y, z, count
    # Unsigned indices: numba looks whether a signed one is negative at every access.
    for run in range(np.uint64(runs[0]), np.uint64(runs[1])):
        start, end = np.uint64(run_start[run] - first), np.uint64(run_start[run + np.uint64(1)] - first)
        if run_cell[run] >= 0:
            cell = np.uint64(run_cell[run])
            for column in range(4):
                sums[cell, column] += upto[end, column] - upto[start, column]


@njit(cache=True, nogil=True)
def _nearest_in_block(points, first, run_start, run_cell, runs, centroids, nearest):  # type: ignore[no-untyped-def]
    for run in range(np.uint64(runs[0]), np.uint64(runs[1])):
        if run_cell[run] >= 0:
            cell = np.uint64(run_cell[run])
            x, y, z, smallest = centroids[cell, 0], centroids[cell, 1], centroids[cell, 2], centroids[cell, 3]
            best = np.int64(nearest[cell])
            start, end = np.uint64(run_start[run] - first), np.uint64(run_start[run + np.uint64(1)] - first)
            for i in range(start, end):
                dx, dy, dz = points[0, i] - x, points[1, i] - y, points[2, i] - z
                distance = dx * dx + dy * dy + dz * dz
                nearer = distance < smallest
                smallest = distance if nearer else smallest
                best = first + np.int64(i) if nearer else best
            centroids[cell, 3], nearest[cell] = smallest, best
