"""Which LiDAR points are in the image: our one answer, and on which points other projects answer otherwise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from detection import inputs
from detection.types import PointFrame
from pipeline.geometry.back_project import pixels_to_velo
from pipeline.geometry.calibration import Calibration, read_calibration
from pipeline.geometry.in_view import in_view, lidar_pixels, pixels_and_depth, value_at
from pipeline.geometry.reference_in_view import in_view_mmdet3d, in_view_openpcdet
from tests.pipeline.geometry.kitti_rig import RIG, SIZE, camera

# 3 mm between the planes of camera 0 and camera 2, as KITTI has; pixel (0, 0) lies straight ahead.
CAMERA = camera([100.0, 0, 0, 0], [0, 100, 0, 0], [0, 0, 1, 0.003])
IMAGE = (10, 20)

# u, v in pixels and depth of camera 0 in metres -> counted by us, by OpenPCDet, by mmdetection3d.
POINTS = {
    "in the middle": ((10, 5, 20.0), (True, True, True)),
    "within half a pixel of the first column's centre": ((-0.3, 5, 20.0), (True, False, False)),
    "within half a pixel of the first row's centre": ((10, -0.3, 20.0), (True, False, False)),
    "nearer to column 20, which does not exist, than to column 19": ((19.7, 5, 20.0), (False, True, True)),
    "the same in rows": ((10, 9.7, 20.0), (False, True, True)),
    "beyond every border": ((20.2, 5, 20.0), (False, False, False)),
    "on the corner of the image": ((0, 0, 20.0), (True, True, False)),
    "on the car itself, nearer than 0.5 m": ((10, 5, 0.3), (False, True, True)),
    "inside by P2's third coordinate, 20.01 when divided by z": ((19.98, 5, 2.0), (False, False, True)),
    "before camera 2, behind camera 0": ((10, 5, -0.0005), (False, False, True)),
    "beyond mmdetection3d's frustum of 100 m": ((10, 5, 120.0), (True, True, False)),
    "behind": ((10, 5, -4.0), (False, False, False)),
}


@pytest.mark.parametrize("name", list(POINTS))
def test_who_counts_which_point(name: str) -> None:
    (u, v, depth), expected = POINTS[name]
    point = pixels_to_velo(np.array([u]), np.array([v]), np.array([depth]), CAMERA)
    answers = tuple(bool(rule(point, CAMERA, IMAGE)[0]) for rule in (in_view, in_view_openpcdet, in_view_mmdet3d))
    assert answers == expected


def test_the_detectors_border_is_openpcdets(rng: np.random.Generator) -> None:
    points = rng.uniform((-5, -40, -5, 0), (90, 40, 5, 1), (4000, 4)).astype(np.float32)
    frame = PointFrame(points, RIG.T_cam_velo, RIG.P2, SIZE)
    border = inputs.in_view_openpcdet(frame)
    assert 200 < border.sum() < 3000
    np.testing.assert_array_equal(border, in_view_openpcdet(points, RIG, SIZE))
    # By hand, u and v over z of camera 0: how it differs from ours is what the table above says.
    x, y, z = (points[:, :3].astype(np.float64) @ RIG.T_cam_velo[:3, :3].T + RIG.T_cam_velo[:3, 3]).T
    u = (721.5377 * x + 609.5593 * z + 44.85728) / z
    v = (721.5377 * y + 172.854 * z + 0.2163791) / z
    np.testing.assert_array_equal(border, (z >= 0) & (u >= 0) & (u < 1242) & (v >= 0) & (v < 375))


def by_loop(points: np.ndarray, calibration: Calibration, size: tuple[int, int]) -> list[int]:
    found = []
    for point in points[:, :3].astype(np.float64):
        cam = calibration.T_cam_velo @ [*point, 1]
        a, b, w = calibration.P2 @ cam
        column, row = (round(a / w), round(b / w)) if w != 0 else (-1, -1)
        inside = cam[2] > 0.5 and 0 <= column < size[1] and 0 <= row < size[0]
        found.append(row * size[1] + column if inside else -1)
    return found


def test_pixels_and_depth_equal_the_loop(rng: np.random.Generator) -> None:
    points = rng.uniform((-5, -40, -5), (90, 40, 5), (2000, 3))
    pixels, depth = pixels_and_depth(points, RIG, SIZE)
    assert pixels.tolist() == by_loop(points, RIG, SIZE)
    np.testing.assert_allclose(depth, RIG.velo_to_cam(points)[:, 2], atol=1e-12)
    np.testing.assert_array_equal(in_view(points, RIG, SIZE), pixels >= 0)
    # Columns of another array and float32 are taken as they come.
    wide = np.asfortranarray(np.column_stack([points, points]).astype(np.float32))
    assert lidar_pixels(wide, RIG, SIZE).tolist() == by_loop(wide, RIG, SIZE)


def test_values_at_points() -> None:
    values = np.arange(6, dtype=np.uint8).reshape(2, 3) + 10
    np.testing.assert_array_equal(value_at(np.array([5, -1, 0]), values), [15, 0, 10])


@pytest.mark.real_data
def test_how_many_points_of_a_real_frame_each_keeps(kitti_object: Path) -> None:
    calibration = read_calibration(kitti_object / "training/calib/000000.txt")
    points = np.fromfile(kitti_object / "training/velodyne/000000.bin", np.float32).reshape(-1, 4)
    size = (370, 1224)
    counts = [int(rule(points, calibration, size).sum()) for rule in (in_view, in_view_openpcdet, in_view_mmdet3d)]
    assert counts == [20259, 20259, 20285]
    # The same number by chance: 7 points each has to itself.
    ours, theirs = in_view(points, calibration, size), in_view_openpcdet(points, calibration, size)
    assert ((ours & ~theirs).sum(), (theirs & ~ours).sum()) == (7, 7)
