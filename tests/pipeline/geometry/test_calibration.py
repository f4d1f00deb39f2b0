"""Calibration files by key name, and the transforms by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.base.errors import DataError
from pipeline.geometry.calibration import (
    Calibration,
    format_calibration,
    parse_calibration,
    parse_raw_calibration,
    read_calibration,
)

P2_LINE = "700 0 600 45 0 700 180 -0.3 0 0 1 0.005"
P3_LINE = "700 0 600 -340 0 700 180 2.2 0 0 1 0.003"
R0_LINE = "1 0 0 0 1 0 0 0 1"
TR_LINE = "0 -1 0 0.01 0 0 -1 -0.08 1 0 0 -0.27"
OBJECT = f"P0: {P2_LINE}\nP2: {P2_LINE}\nP3: {P3_LINE}\nR0_rect: {R0_LINE}\nTr_velo_to_cam: {TR_LINE}\n"


def test_object_tracking_and_odometry_spellings_mean_the_same() -> None:
    tracking = f"P2: {P2_LINE}\nP3: {P3_LINE}\nR_rect {R0_LINE}\nTr_velo_cam {TR_LINE}\n"
    odometry = f"P2: {P2_LINE}\nP3: {P3_LINE}\nTr: {TR_LINE}\n"
    for text in (tracking, odometry):
        parsed, expected = parse_calibration(text), parse_calibration(OBJECT)
        np.testing.assert_array_equal(parsed.P2, expected.P2)
        np.testing.assert_array_equal(parsed.T_cam_velo, expected.T_cam_velo)


def test_raw_drives_have_two_files() -> None:
    cameras = f"calib_time: 09-Jan-2012 13:57:47\nP_rect_02: {P2_LINE}\nP_rect_03: {P3_LINE}\nR_rect_00: {R0_LINE}\n"
    velodyne = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0.01 -0.08 -0.27\n"
    raw, expected = parse_raw_calibration(cameras, velodyne), parse_calibration(OBJECT)
    np.testing.assert_array_equal(raw.T_cam_velo, expected.T_cam_velo)
    assert raw.P3 is not None


def test_transforms_by_hand() -> None:
    calibration = parse_calibration(OBJECT)
    # 10 m forward, 2 m left, 1 m up of the LiDAR: 2 m left is x = -2 + 0.01, 1 m up is y = -1 - 0.08.
    camera = calibration.velo_to_cam(np.array([[10.0, 2.0, 1.0, 0.5]]))
    np.testing.assert_allclose(camera, [[-1.99, -1.08, 9.73]])
    pixels, depth = calibration.cam_to_image(camera)
    scale = 9.73 + 0.005
    expected = [(700 * -1.99 + 600 * 9.73 + 45) / scale, (700 * -1.08 + 180 * 9.73 - 0.3) / scale]
    np.testing.assert_allclose(pixels, [expected])
    assert depth[0] == 9.73
    np.testing.assert_allclose(calibration.cam_to_velo(camera), [[10, 2, 1]], atol=1e-12)


def test_lidar_points_are_rectified_after_the_step_to_camera_0() -> None:
    """R0_rect turns by 90 degrees about the vertical (x' = z, z' = -x): no identity hides whether, or when, it acts."""
    calibration = parse_calibration(OBJECT.replace(f"R0_rect: {R0_LINE}", "R0_rect: 0 0 1 0 1 0 -1 0 0"))
    # The LiDAR's (10, 2, 1) is (-1.99, -1.08, 9.73) in camera 0.
    np.testing.assert_allclose(calibration.velo_to_cam(np.array([[10.0, 2.0, 1.0]])), [[9.73, -1.08, 1.99]])
    np.testing.assert_allclose(calibration.cam_to_velo(np.array([[9.73, -1.08, 1.99]])), [[10, 2, 1]], atol=1e-12)


def test_a_crop_moves_the_principal_point() -> None:
    cropped = parse_calibration(OBJECT).cropped(top=20, left=50)
    point = np.array([[1.0, 2.0, 8.0]])
    before, after = parse_calibration(OBJECT).cam_to_image(point)[0], cropped.cam_to_image(point)[0]
    np.testing.assert_allclose(before - after, [[50, 20]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (OBJECT.replace("P2:", "P9:"), "expected a line 'P2:', got P0, P3, P9"),
        (OBJECT.replace("R0_rect", "R1"), r"expected a line 'R0_rect:' \(or R_rect, R_rect_00\)"),
        (OBJECT.replace("Tr_velo_to_cam", "Tr_imu"), r"expected a line 'Tr_velo_to_cam:' \(or Tr_velo_cam, Tr\)"),
        (OBJECT.replace("P2: 700 0", "P2: 700"), "P2\\): expected 12 or 16 numbers, got 11"),
        (OBJECT.replace("P2: 700", "P2: nan"), "P2\\): expected finite numbers"),
        (OBJECT.replace("P2: 700", "P2: -700"), "positive focal lengths"),
        ("", "no key at all"),
        ("Car 0.00 0 -1.57 1 2 3 4 1.5 1.6 3.9 0 1 10 0\n", "label file"),
    ],
)
def test_what_is_missing_is_named_and_nothing_is_guessed(text: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        parse_calibration(text, "calib/000001.txt")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        read_calibration(tmp_path / "none.txt")
    (tmp_path / "bytes.txt").write_bytes(b"P2: \xff\xfe")
    with pytest.raises(DataError, match="not UTF-8"):
        read_calibration(tmp_path / "bytes.txt")


def test_written_calibration_reads_back() -> None:
    calibration = parse_calibration(OBJECT)
    again = parse_calibration(format_calibration(calibration))
    np.testing.assert_array_equal(again.P2, calibration.P2)
    np.testing.assert_array_equal(again.T_cam0_velo, calibration.T_cam0_velo)
    assert again.P3 is not None
    assert calibration.P3 is not None
    np.testing.assert_array_equal(again.P3, calibration.P3)


def test_shapes_are_checked() -> None:
    with pytest.raises(DataError, match="R0_rect"):
        Calibration(P2=np.eye(3, 4), R0_rect=np.eye(4), T_cam0_velo=np.eye(4))


@pytest.mark.real_data
def test_points_of_a_labelled_car_fall_into_its_2d_box(kitti_object: Path) -> None:
    from detection.boxes import project_to_image
    from detection.kitti_format import boxes_of
    from pipeline.data import open_dataset

    frame = open_dataset("kitti_object", kitti_object)["000008"]
    cars = [item for item in frame.labels if item.type == "Car" and item.truncated < 0.1]
    projected = project_to_image(boxes_of(cars), frame.calibration.P2, frame.image_size)
    labelled = np.array([item.bbox for item in cars])
    assert np.abs(projected - labelled).max() < 8
