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
from pipeline.pointcloud.cells import CellBuilder, Cells
from pipeline.pointcloud.clouds import DenseCloud
from pipeline.pointcloud.grid_sampling import GridSampling, add_block, first_of_cells, nearest_in_block, settle

# A block of this many pixels (three coordinates, 290 kB) stays in the second-level cache between its uses.
_BLOCK_PIXELS = 24_000


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
    cells, sums, runs_of_block = _cells_and_sums(depth, kept.reshape(-1), rays, grid)
    if grid.representative == "first":
        pixels = first_of_cells(cells).astype(np.int32)
        return DenseCloud(rays.project_pixels(depth, pixels), pixels)
    sums[:, :3] /= sums[:, 3:]
    if grid.representative == "centroid":
        return DenseCloud(sums[:, :3].astype(np.float32), first_of_cells(cells).astype(np.int32))
    sums[:, 3] = np.inf
    pixels = np.zeros(len(cells), np.int32)
    for block, runs in zip(_blocks(depth, rays), runs_of_block):
        settle(block.points)
        nearest_in_block(block.points, block.first, cells, runs, sums, pixels)
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


def _cells_and_sums(
    depth: NDArray[np.float32], kept: NDArray[np.bool_], rays: PixelRays, grid: GridSampling
) -> tuple[Cells, NDArray[np.float64], list[tuple[int, int]]]:
    """Occupied cells of the kept pixels, (M, 4) sums of x, y, z and count (zero for "first"), and each block's runs."""
    builder = CellBuilder(depth.size, 1.0 / grid.size, "grid sampling")
    builder.check(rays.reach(depth))
    sums, runs_of_block = np.zeros((len(builder.keys), 4)), []
    for block in _blocks(depth, rays):
        runs = builder.add(block.points, block.first, kept)
        runs_of_block.append(runs)
        if grid.representative != "first":
            if len(sums) < builder.count:
                sums = np.concatenate([sums, np.zeros((len(builder.keys) - len(sums), 4))])
            settle(block.points)
            add_block(block.points, block.first, builder.cells(), runs, sums)
    return builder.cells(), sums[: builder.count], runs_of_block
