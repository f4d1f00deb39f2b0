"""A LiDAR-like subsampling of dense depth: one pixel per cell of an azimuth-elevation grid.

The grid is the one of the pseudo-LiDAR line that the thesis cites for its 64R to 512R inputs: elevation from +2 degrees
downwards in steps of 0.4 degrees x 64 / rows, azimuth from +45 degrees over 90 degrees in `columns` steps. Pixels out
of the grid are dropped (clamping would pile them up in the border cells), the nearest pixel of a cell is kept, and its
depth is copied, so that the sparse map agrees with the dense one exactly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.back_project import back_project, pixels_to_velo
from pipeline.geometry.calibration import Calibration

TOP_ELEVATION = np.deg2rad(2.0)
ELEVATION_STEP_64 = np.deg2rad(0.4)
LEFT_AZIMUTH = np.deg2rad(45.0)
COLUMNS = 512
# Grid rows of 64R: 0.4 degrees each from +2 to -23.6 degrees. Finer patterns have more rows in the same field of view.
GRID_ROWS = 64
MAX_DEPTH = 120.0


def sample_like_lidar(
    depth: NDArray[np.float32], calibration: Calibration, rows: int = 64, columns: int = COLUMNS
) -> NDArray[np.float32]:
    """(H, W) dense metres -> (H, W) sparse metres, 0 = none, the same values at the pixels that are kept.

    rows     64, 128, 256 or 512 lines over the same field of view
    columns  azimuth steps over 90 degrees (a real HDL-64E at 10 Hz has about 520)
    The sensor stands at the LiDAR origin of the calibration.
    """
    v, u = np.nonzero((depth > 0) & (depth < MAX_DEPTH))
    z = depth[v, u].astype(np.float64)
    points = pixels_to_velo(u, v, z, calibration)
    reach = np.linalg.norm(points, axis=1)
    elevation = np.arcsin(points[:, 2] / reach)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    row = np.floor((TOP_ELEVATION - elevation) / (ELEVATION_STEP_64 * 64 / rows)).astype(np.int64)
    column = np.floor((LEFT_AZIMUTH - azimuth) / (2 * LEFT_AZIMUTH / columns)).astype(np.int64)
    inside = (row >= 0) & (row < GRID_ROWS * rows // 64) & (column >= 0) & (column < columns)
    cell = np.where(inside, row * columns + column, -1)
    order = np.lexsort((reach, cell))
    order = order[cell[order] >= 0]
    first = np.ones(len(order), dtype=bool)
    first[1:] = cell[order][1:] != cell[order][:-1]
    kept = order[first]
    sparse = np.zeros_like(depth)
    sparse[v[kept], u[kept]] = depth[v[kept], u[kept]]
    return sparse


def depth_points(depth: NDArray[np.float32], calibration: Calibration) -> NDArray[np.float32]:
    """(N, 4) x y z intensity (0) in the LiDAR frame of the pixels with a value, row by row."""
    xyz = back_project(depth, calibration, depth > 0).points
    return np.column_stack([xyz, np.zeros(len(xyz), np.float32)])
