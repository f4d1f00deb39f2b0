"""Back-projection and grid sampling in one go, block by block of image rows.

The result is that of `back_project` followed by `grid_sampling`, bit for bit (a test compares them); the full cloud of
some 400,000 points, which only its 30,000 representatives survive, is never written to memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data.calibration import Calibration
from pipeline.pointcloud.backproject import PixelRays, usable_pixels
from pipeline.pointcloud.cells import Cells, cut_into_runs, numbered, refuse
from pipeline.pointcloud.clouds import DenseCloud
from pipeline.pointcloud.grid_sampling import GridSampling, add_block, first_of_cells, nearest_in_block, settle

# A block of this many pixels (three coordinates, 190 kB) stays in the second-level cache between its uses.
_BLOCK_PIXELS = 16_000


@dataclass(frozen=True)
class _Block:
    """Points of some image rows: (3, n) `points` of pixels first ... first + n - 1."""

    points: NDArray[np.float32]
    first: int


def back_project_and_sample(
    depth: NDArray[np.float32], calibration: Calibration, keep: NDArray[np.bool_], grid: GridSampling
) -> DenseCloud:
    """(H, W) depth in metres -> one point per occupied cell, as `grid_sampling(back_project(...), grid)`.

    Raises DataError for NaN, infinite or negative depth and ValueError for points too far for the cell size.
    """
    depth, kept = usable_pixels(depth, keep)
    rays = PixelRays.of(calibration, (depth.shape[0], depth.shape[1]))
    cells = _cells(depth, kept.reshape(-1), rays, 1.0 / grid.size)
    if grid.representative == "first":
        pixels = first_of_cells(cells).astype(np.int32)
        return DenseCloud(rays.project_pixels(depth, pixels), pixels)
    sums = np.zeros((len(cells), 4))
    at = 0
    for block in _blocks(depth, rays):
        settle(block.points)
        at = add_block(block.points, block.first, cells, at, sums)
    sums[:, :3] /= sums[:, 3:]
    if grid.representative == "centroid":
        return DenseCloud(sums[:, :3].astype(np.float32), first_of_cells(cells).astype(np.int32))
    sums[:, 3] = np.inf
    pixels, at = np.zeros(len(cells), np.int32), 0
    for block in _blocks(depth, rays):
        settle(block.points)
        at = nearest_in_block(block.points, block.first, cells, at, sums, pixels)
    return DenseCloud(rays.project_pixels(depth, pixels), pixels)


def _blocks(depth: NDArray[np.float32], rays: PixelRays) -> Iterator[_Block]:
    """The points of all pixels, some rows at a time; the memory of a block is used again by the next."""
    height, width = depth.shape
    if not depth.size:
        return
    memory = np.empty((3, max(1, _BLOCK_PIXELS // width) * width), np.float32)
    top = 0
    while top < height:
        rows = rays.project_rows(depth, top, memory)
        yield _Block(memory[:, : rows * width], top * width)
        top += rows


def _cells(depth: NDArray[np.float32], kept: NDArray[np.bool_], rays: PixelRays, inverse_size: float) -> Cells:
    """Occupied cells of the kept pixels."""
    run_start, run_key = np.empty(depth.size + 1, np.int32), np.empty(depth.size, np.int64)
    runs = 0
    for block in _blocks(depth, rays):
        runs = cut_into_runs(block.points, block.first, kept, inverse_size, runs, run_start, run_key)
        if runs < 0:
            refuse(True, inverse_size, "grid sampling")
    return numbered(run_start[: runs + 1], run_key[:runs], depth.size)
