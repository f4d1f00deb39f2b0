"""Back-projection and grid sampling in one go, block by block of image rows.

The result is that of `back_project` followed by `grid_sampling`, bit for bit (a test compares them); the full cloud of
some 400,000 points, which only its 30,000 representatives survive, is kept only for the centroids.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.back_project import PixelRays, usable_pixels
from pipeline.geometry.calibration import Calibration
from pipeline.geometry.clouds import DenseCloud
from pipeline.pointcloud.cells import CellBuilder
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
    rays = PixelRays.of(calibration)
    builder = CellBuilder(1.0 / grid.size, "grid sampling")
    builder.check(rays.reach(depth))
    blocks = []
    for block in _blocks(depth, rays, stay=grid.representative != "first"):
        builder.add(block.points, block.first, kept.reshape(-1))
        blocks.append(block)
    cells = builder.cells()
    if grid.representative == "first":
        pixels = first_of_cells(cells).astype(np.int32)
        return DenseCloud(rays.project_pixels(depth, pixels), pixels)
    centroids = np.zeros((len(cells), 4))
    for block, runs in zip(blocks, builder.block_runs, strict=True):
        settle(block.points)
        add_block(block.points, block.first, cells, runs, centroids)
    centroids[:, :3] /= centroids[:, 3:]
    if grid.representative == "centroid":
        return DenseCloud(centroids[:, :3].astype(np.float32), first_of_cells(cells).astype(np.int32))
    centroids[:, 3] = np.inf
    pixels = np.zeros(len(cells), np.int32)
    for block, runs in zip(blocks, builder.block_runs, strict=True):
        nearest_in_block(block.points, block.first, cells, runs, centroids, pixels)
    return DenseCloud(rays.project_pixels(depth, pixels), pixels)


def _blocks(depth: NDArray[np.float32], rays: PixelRays, stay: bool) -> Iterator[_Block]:
    """The points of all pixels, some rows at a time; unless they are to stay, the next block takes their memory."""
    height, width = depth.shape
    if not depth.size:
        return
    rows_at_once = max(1, _BLOCK_PIXELS // width)
    count = -(-height // rows_at_once)
    memory = np.empty((count if stay else 1, 3, rows_at_once * width), np.float32)
    for number in range(count):
        block, top = memory[number if stay else 0], number * rows_at_once
        rows = rays.project_rows(depth, top, block)
        yield _Block(block[:, : rows * width], top * width)
