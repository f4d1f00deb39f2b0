"""Back-projection is the exact inverse of the projection: round trips with the whole P2, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.base.errors import DataError
from pipeline.geometry.back_project import PixelRays, back_project, depth_pixels, pixels_to_velo
from pipeline.geometry.calibration import Calibration, read_calibration
from pipeline.geometry.in_view import lidar_pixels
from pipeline.geometry.project import project_points
from tests.pipeline.geometry.kitti_rig import RIG, SIZE, camera


def there_and_back(calibration: Calibration, depth: np.ndarray) -> None:
    """Every pixel of the map comes back to itself within 1e-3 px and 1e-4 m, by every way there is."""
    cloud = back_project(depth, calibration, depth > 0)
    pixels, z = calibration.cam_to_image(calibration.velo_to_cam(cloud.points))
    row, column = np.divmod(cloud.pixels, depth.shape[1])
    np.testing.assert_allclose(pixels, np.column_stack([column, row]), atol=1e-3)
    np.testing.assert_allclose(z, depth[depth > 0], atol=1e-4)
    np.testing.assert_array_equal(lidar_pixels(cloud.points, calibration, depth.shape), cloud.pixels)
    np.testing.assert_allclose(project_points(cloud.points, calibration, depth.shape), depth, atol=1e-4)
    listed = pixels_to_velo(*depth_pixels(depth), calibration)
    np.testing.assert_allclose(listed, cloud.points, atol=1e-5)


def test_pixels_come_back_to_themselves_with_the_whole_p2(rng: np.random.Generator) -> None:
    assert RIG.P2[2, 3] == 0.002745884
    there_and_back(RIG, rng.uniform(0.6, 90, SIZE).astype(np.float32))


@pytest.mark.real_data
@pytest.mark.parametrize("name", ["000000", "000001", "000008"])
def test_pixels_come_back_with_calibrations_of_the_samples(
    kitti_object: Path, name: str, rng: np.random.Generator
) -> None:
    calibration = read_calibration(kitti_object / f"training/calib/{name}.txt")
    assert calibration.P2[2, 3] > 0.002
    there_and_back(calibration, rng.uniform(0.6, 90, SIZE).astype(np.float32))


def test_what_the_third_row_of_p2_is_worth() -> None:
    # x = (u w - cu z - p0) / fu with w = z + P2[2, 3]; with w = z the last column is off by
    # u P2[2, 3] / fu = 1241 * 0.002745884 / 721.5377 = 4.7 mm, and 1241 * 0.002745884 / 2.002745884 = 1.7 px.
    exact = RIG.velo_to_cam(pixels_to_velo(np.array([1241]), np.array([0]), np.array([2.0]), RIG))
    usual = (1241 - RIG.P2[0, 2]) / RIG.P2[0, 0] * 2 - RIG.P2[0, 3] / RIG.P2[0, 0]
    assert exact[0, 0] - usual == pytest.approx(0.0047227, abs=1e-6)
    wrong = RIG.cam_to_image(np.array([[usual, exact[0, 1], 2.0]]))[0]
    assert wrong[0, 0] == pytest.approx(1241 - 1.7015, abs=1e-3)


@settings(max_examples=80, deadline=None)
@given(
    st.floats(20, 2000), st.floats(-30, 30), st.floats(0.2, 5), st.floats(-0.05, 0.05),
    st.floats(-10, 2000), st.floats(-10, 600), st.floats(0.5, 120),
)  # fmt: skip
def test_any_camera_with_a_parallel_image_plane(
    focal: float, skew: float, scale: float, ahead: float, u: float, v: float, depth: float
) -> None:
    calibration = camera(
        [focal, skew, 310.5, 12.0], [0, 0.9 * focal, 120.2, -3.0], [0, 0, scale, scale * ahead]
    )  # fmt: skip
    point = pixels_to_velo(np.array([u]), np.array([v]), np.array([depth]), calibration)
    pixels, z = calibration.cam_to_image(calibration.velo_to_cam(point))
    np.testing.assert_allclose(pixels[0], [u, v], atol=1e-6)
    np.testing.assert_allclose(z, depth, rtol=1e-9)


def test_a_tilted_image_plane_is_refused() -> None:
    tilted = camera([100.0, 0, 10, 0], [0, 100, 5, 0], [0.001, 0, 1, 0])
    with pytest.raises(DataError, match=r"third row 0 0 s t with s > 0 .*0\.001 0 1 0"):
        back_project(np.ones((4, 5), np.float32), tilted, np.ones((4, 5), bool))
    with pytest.raises(DataError, match=r"third row 0 0 s t"):
        pixels_to_velo(np.zeros(1), np.zeros(1), np.ones(1), camera([100.0, 0, 10, 0], [0, 100, 5, 0], [0, 0, -1, 0]))


def test_no_point_is_farther_than_the_reach(rng: np.random.Generator) -> None:
    depth = rng.uniform(0, 80, (30, 50)).astype(np.float32)
    cloud = back_project(depth, RIG, depth > 0)
    rays = PixelRays.of(RIG)
    assert np.abs(cloud.points).max() <= rays.reach(depth)
    assert rays.reach(depth) < 3 * depth.max()
