"""Grid sampling: one representative point per cubic cell (thesis 5.3.4.2, Table 5.5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeline.pointcloud.cells import assign_cells, refuse
from pipeline.pointcloud.clouds import DenseCloud

Representative = Literal["nearest", "first", "centroid"]


@dataclass(frozen=True)
class GridSampling:
    """The grid.

    size            edge of a cell in metres (thesis: 0.2 in 5.3.4.2 and Fig. 5.7, 0.1 in Tables 5.5 and 5.7)
    representative  "nearest": the point nearest to the centroid of its cell; "first": in row order; "centroid": the mean
    """

    size: float = 0.2
    representative: Representative = "nearest"

    def __post_init__(self) -> None:
        if not 0 < self.size < np.inf:
            raise ValueError(f"grid sampling: expected a cell size > 0 m, got {self.size:g}")
        if self.representative not in ("nearest", "first", "centroid"):
            raise ValueError(f"grid sampling: expected nearest, first or centroid, got {self.representative!r}")


def grid_sample(points: NDArray[np.float32], grid: GridSampling) -> NDArray[np.int64]:
    """(N, 3) points -> (M,) index of the representative of every occupied cell, in order of first appearance.

    A point lies in cell floor(coordinate * (1 / size)), computed in float64. The centroid is the float64 mean in the
    order of the points; of equally near points the first wins. For "centroid" the index is that of the nearest point,
    whose pixel the mean takes (see `grid_sampling`).

    Raises ValueError for NaN or infinite coordinates.
    """
    cell_of_point, cells = _cells(points, grid.size)
    representatives = np.empty(cells, np.int64)
    if grid.representative == "first":
        _first(cell_of_point, representatives)
    else:
        sums = np.zeros((cells, 4))
        _accumulate(points, cell_of_point, sums)
        _nearest_to_centroid(points, cell_of_point, sums, np.full(cells, np.inf), representatives)
    return representatives


def grid_centroids(points: NDArray[np.float32], grid: GridSampling) -> NDArray[np.float32]:
    """(N, 3) points -> (M, 3) float32 mean of every occupied cell, cells in the order of `grid_sample`."""
    cell_of_point, cells = _cells(points, grid.size)
    sums = np.zeros((cells, 4))
    _accumulate(points, cell_of_point, sums)
    return (sums[:, :3] / sums[:, 3:]).astype(np.float32)


def grid_sampling(cloud: DenseCloud, grid: GridSampling) -> DenseCloud:
    """The sampled cloud. With "centroid" the points are means and keep the pixel of the nearest member."""
    sampled = cloud.select(grid_sample(cloud.points, grid))
    if grid.representative == "centroid":
        return DenseCloud(grid_centroids(cloud.points, grid), sampled.pixels)
    return sampled


def _cells(points: NDArray[np.float32], size: float) -> tuple[NDArray[np.int32], int]:
    """Cell number of every point, numbered by first appearance, and how many cells there are."""
    if points.ndim != 2 or points.shape[1] < 3 or points.dtype != np.float32:
        raise ValueError(f"grid sampling: expected (N, 3) float32 points, got {points.shape} {points.dtype}")
    cell_of_point = np.empty(len(points), np.int32)
    cells, _, _ = assign_cells(points, 1.0 / size, cell_of_point)
    refuse(cells, "grid sampling", size)
    return cell_of_point, cells


@njit(cache=True, nogil=True)
def _first(cell_of_point, representatives):  # type: ignore[no-untyped-def]
    seen = 0
    for i in range(cell_of_point.size):
        if cell_of_point[i] == seen:
            representatives[seen] = i
            seen += 1


@njit(cache=True, nogil=True)
def _accumulate(points, cell_of_point, sums):  # type: ignore[no-untyped-def]
    for i in range(cell_of_point.size):
        cell = cell_of_point[i]
        sums[cell, 0] += points[i, 0]
        sums[cell, 1] += points[i, 1]
        sums[cell, 2] += points[i, 2]
        sums[cell, 3] += 1


@njit(cache=True, nogil=True)
def _nearest_to_centroid(points, cell_of_point, sums, nearest, representatives):  # type: ignore[no-untyped-def]
    for cell in range(nearest.size):
        for axis in range(3):
            sums[cell, axis] = sums[cell, axis] / sums[cell, 3]
    for i in range(cell_of_point.size):
        cell = cell_of_point[i]
        dx, dy, dz = points[i, 0] - sums[cell, 0], points[i, 1] - sums[cell, 1], points[i, 2] - sums[cell, 2]
        distance = dx * dx + dy * dy + dz * dz
        if distance < nearest[cell]:
            nearest[cell] = distance
            representatives[cell] = i
