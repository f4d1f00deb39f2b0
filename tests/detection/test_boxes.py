"""Geometry of boxes: corners and projections by hand, round trips between the camera's and the LiDAR's form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detection.boxes import corners, from_lidar, observation_angle, project_to_image, to_lidar, wrap_angle
from detection.types import Boxes3D

# LiDAR x forward, y left, z up -> camera x right, y down, z forward; the LiDAR 0.27 m behind and 0.08 m above.
T_CAM_VELO = np.array([[0, -1.0, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])
ANGLE = st.floats(-10, 10)
BOX = st.tuples(*[st.floats(-60, 60)] * 3, *[st.floats(0.1, 12)] * 3, ANGLE)


def test_corners_by_hand() -> None:
    # ry = 0: length along x, width along z; bottom at y = 2, top at y = 2 - h.
    (found,) = corners(Boxes3D(np.array([[10.0, 2.0, 20.0, 1.5, 1.6, 4.0, 0.0]])))
    assert {tuple(np.round(corner, 6)) for corner in found} == {
        (x, y, z) for x in (8.0, 12.0) for y in (2.0, 0.5) for z in (19.2, 20.8)
    }
    assert (found[:4, 1] == 2).all()  # the bottom face first
    # A quarter turn: the front (+l/2) that looked along +x looks along -z.
    (turned,) = corners(Boxes3D(np.array([[10.0, 2.0, 20.0, 1.5, 1.6, 4.0, np.pi / 2]])))
    np.testing.assert_allclose(turned[:2].mean(axis=0), [10, 2, 18], atol=1e-12)


def test_projection_by_hand() -> None:
    camera = np.array([[100.0, 0, 50, 0], [0, 100, 40, 0], [0, 0, 1, 0]])
    box = Boxes3D(np.array([[0.0, 1.0, 10.0, 2.0, 2.0, 2.0, 0.0]]))
    # The nearest face is at z = 9: +-1 m become +-11.11 pixels.
    np.testing.assert_allclose(
        project_to_image(box, camera), [[50 - 100 / 9, 40 - 100 / 9, 50 + 100 / 9, 40 + 100 / 9]]
    )
    np.testing.assert_allclose(project_to_image(box, camera, (45, 55))[0, 2:], [54, 44])
    beside = Boxes3D(np.array([[3.0, 1.0, 0.0, 2.0, 2.0, 4.0, np.pi / 2]]))  # half behind the camera
    assert np.isfinite(project_to_image(beside, camera, (45, 55))).all()


def test_observation_angle_by_hand() -> None:
    boxes = Boxes3D(np.array([[0, 0, 10, 1, 1, 1, 0.5], [10, 0, 10, 1, 1, 1, 0.0], [0, 0, 5, 1, 1, 1, 3 * np.pi]]))
    np.testing.assert_allclose(observation_angle(boxes), [0.5, -np.pi / 4, -np.pi])


@given(ANGLE)
def test_wrapped_angles_point_the_same_way(angle: float) -> None:
    wrapped = float(wrap_angle(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-9)


def test_a_car_ahead_in_lidar_form_by_hand() -> None:
    # Looks forward (ry = -pi/2), 10 m ahead of the camera, bottom 1.65 m below it.
    (row,) = to_lidar(Boxes3D(np.array([[0, 1.65, 10, 1.5, 1.6, 4.0, -np.pi / 2]])), np.linalg.inv(T_CAM_VELO))
    np.testing.assert_allclose(row, [10.27, 0, -(1.65 - 0.75) - 0.08, 4.0, 1.6, 1.5, 0], atol=1e-12)


@given(BOX)
def test_lidar_form_and_back(values: tuple[float, ...]) -> None:
    boxes = Boxes3D(np.array([values]))
    again = from_lidar(to_lidar(boxes, np.linalg.inv(T_CAM_VELO)), T_CAM_VELO)
    np.testing.assert_allclose(again.values[:, :6], boxes.values[:, :6], atol=1e-9)
    np.testing.assert_allclose(np.cos(again.ry - boxes.ry), 1, atol=1e-9)


@given(BOX)
def test_corners_lie_at_half_the_diagonal(values: tuple[float, ...]) -> None:
    (found,) = corners(Boxes3D(np.array([values])))
    x, y, z, h, w, l, _ = values
    distance = np.linalg.norm(found - np.array([x, y - h / 2, z]), axis=1)
    np.testing.assert_allclose(distance, np.sqrt(h * h + w * w + l * l) / 2, rtol=1e-6)
