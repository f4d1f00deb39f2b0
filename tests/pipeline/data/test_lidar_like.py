"""LiDAR-like subsampling of dense depth: one nearest pixel per azimuth-elevation cell, values copied."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.data import open_dataset
from pipeline.data.kitti_depth import camera_only
from pipeline.data.lidar_like import depth_points, sample_like_lidar
from tests.pipeline.data.vkitti2_tree import CX, FOCAL, HEIGHT, WIDTH, write_tree

# Off the data set's 187, where the horizon falls on a border of the grid and rounding decides.
CY = 187.3
CAMERA = camera_only(np.array([[FOCAL, 0, CX], [0, FOCAL, CY], [0, 0, 1]]))


def reference(depth: np.ndarray, rows: int) -> np.ndarray:
    """The same, pixel by pixel."""
    best: dict[tuple[int, int], tuple[float, int, int]] = {}
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = float(depth[v, u])
            if not 0 < z < 120:
                continue
            x, y = (u - CX) / FOCAL * z, (v - CY) / FOCAL * z
            reach = np.sqrt(x * x + y * y + z * z)
            elevation, azimuth = np.degrees(np.arcsin(-y / reach)), np.degrees(np.arctan2(-x, z))
            row, column = int((2 - elevation) // (0.4 * 64 / rows)), int((45 - azimuth) // (90 / 512))
            if 0 <= row < rows and 0 <= column < 512:
                best[row, column] = min(best.get((row, column), (np.inf, 0, 0)), (reach, v, u))
    sparse = np.zeros_like(depth)
    for _, v, u in best.values():
        sparse[v, u] = depth[v, u]
    return sparse


@pytest.mark.parametrize("rows", [64, 256])
def test_against_the_loop(rows: int, rng: np.random.Generator) -> None:
    depth = np.zeros((HEIGHT, WIDTH), np.float32)
    depth[150:230, 560:680] = rng.uniform(2, 130, (80, 120))
    np.testing.assert_array_equal(sample_like_lidar(depth, CAMERA, rows), reference(depth, rows))


def test_density_grows_with_the_rows() -> None:
    depth = np.full((HEIGHT, WIDTH), 20.0, np.float32)
    counts = [int((sample_like_lidar(depth, CAMERA, rows) > 0).sum()) for rows in (64, 128, 256)]
    # A 375-row image spans 28 degrees: 16.6 below +2 here, about 42 of the 64 rows.
    assert 0.03 < counts[0] / depth.size < 0.06
    assert counts[1] == pytest.approx(2 * counts[0], rel=0.05)
    assert counts[0] < counts[1] < counts[2]


def test_virtual_kitti_frames_have_a_sparse_input(tmp_path: Path) -> None:
    frame = open_dataset("vkitti2", write_tree(tmp_path, "Scene20", 1))[0]
    sparse = frame.sparse_depth
    assert 0.005 < (sparse > 0).mean() < 0.06
    np.testing.assert_array_equal(sparse[sparse > 0], frame.target_depth[sparse > 0])
    points = frame.points
    assert points.shape == ((sparse > 0).sum(), 4)
    np.testing.assert_allclose(np.sort(points[:, 0]), np.sort(sparse[sparse > 0]), rtol=1e-6)
    np.testing.assert_array_equal(points, depth_points(sparse, frame.calibration))
