"""Projection of LiDAR to a depth map: pixels by hand, nearest point first, an obvious loop as its twin."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from pipeline.geometry.calibration import Calibration
from pipeline.geometry.project import project_points

# LiDAR axes turned into camera axes at the same place; 10 pixels focal length, image centre at (5, 4).
TURN = np.array([[0, -1.0, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
CAMERA = Calibration(P2=np.array([[10.0, 0, 5, 0], [0, 10, 4, 0], [0, 0, 1, 0]]), R0_rect=np.eye(3), T_cam0_velo=TURN)


def project_by_loop(points: np.ndarray, size: tuple[int, int], min_depth: float) -> np.ndarray:
    depth = np.zeros(size, np.float32)
    for x, y, z in points[:, :3].astype(np.float64):
        right, down, forward = -y, -z, x
        if forward <= min_depth:
            continue
        u, v = np.rint(10 * right / forward + 5), np.rint(10 * down / forward + 4)
        if 0 <= u < size[1] and 0 <= v < size[0]:
            row, column = int(v), int(u)
            if depth[row, column] == 0 or forward < depth[row, column]:
                depth[row, column] = forward
    return depth


def test_a_point_by_hand() -> None:
    # 10 m forward, 2 m to the right (y = -2), 1 m down: u = 10 * 2 / 10 + 5 = 7, v = 10 * 1 / 10 + 4 = 5.
    depth = project_points(np.array([[10.0, -2.0, -1.0, 0.3]], np.float32), CAMERA, (8, 10))
    assert depth[5, 7] == 10
    assert np.count_nonzero(depth) == 1
    assert depth.dtype == np.float32


def test_the_nearest_point_wins_in_any_order() -> None:
    points = np.array([[20.0, 0, 0, 0], [5.0, 0, 0, 0], [9.0, 0, 0, 0]], np.float32)
    for order in ([0, 1, 2], [2, 1, 0], [1, 0, 2]):
        assert project_points(points[order], CAMERA, (8, 10))[4, 5] == 5


def test_points_behind_and_outside_are_left_out() -> None:
    points = np.array([[-5.0, 0, 0, 0], [0.4, 0, 0, 0], [5.0, 50.0, 0, 0]], np.float32)
    assert not project_points(points, CAMERA, (8, 10)).any()
    assert not project_points(np.zeros((0, 4), np.float32), CAMERA, (8, 10)).any()


@settings(max_examples=60, deadline=None)
@given(arrays.arrays(np.float32, st.tuples(st.integers(0, 40), st.just(4)), elements=st.floats(-20, 20, width=32)))
def test_the_loop_agrees(points: np.ndarray) -> None:
    # Points exactly between two pixels may round to either; they are moved off the border.
    points = points + np.float32(1e-3)
    np.testing.assert_allclose(
        project_points(points, CAMERA, (8, 10)), project_by_loop(points, (8, 10), 0.5), rtol=1e-6
    )
