"""From the LiDAR frame to the networks' input."""

from __future__ import annotations

import numpy as np
import pytest

from detection.inputs import (
    CameraCloud,
    InputSettings,
    camera_cloud,
    ground_height,
    mirrored,
    network_input,
    point_features,
    truth_boxes,
)
from detection.kitti_format import KittiObject, boxes_of, parse_lines
from detection.types import PointFrame
from tests.detection.scenes import IMAGE_SIZE, P2, T_CAM_VELO, box_frame


def frame_of(camera_points: list[list[float]], size: tuple[int, int] = IMAGE_SIZE) -> PointFrame:
    xyz = np.array(camera_points)
    velo = xyz @ T_CAM_VELO[:3, :3]
    return PointFrame(np.column_stack([velo, np.arange(len(xyz))]).astype(np.float32), T_CAM_VELO, P2, size, "f")


def kept(frame: PointFrame) -> list[float]:
    return camera_cloud(frame).columns[:, 0].tolist()


def test_only_visible_points_in_range_stay() -> None:
    # Right edge at z = 10: u = (721.5 * 8.7 + 609.6 * 10 + 44.86) / 10 = 1241.8 is inside, x = 8.71 is not.
    points = [
        [0, 0, 10],
        [8.7, 0, 10],
        [8.71, 0, 10],
        [0, 0, 70.39],
        [0, 0, 70.5],
        [0, -1.1, 20],
        [0, 3.1, 20],
        [0, 0, -5],
    ]
    assert kept(frame_of(points)) == [0, 1, 3]


def test_the_frame_s_own_image_size_counts() -> None:
    points = [[0.0, 2.7, 10.0]]  # v = (721.5 * 2.7 + 1729.2) / 10 = 367.7
    assert kept(frame_of(points, (375, 1242))) == [0]
    assert kept(frame_of(points, (360, 1242))) == []


def test_heights_on_a_slope_under_a_box(rng) -> None:
    xz = np.column_stack([rng.uniform(-20, 20, 8000), rng.uniform(5, 60, 8000)])
    slope = 1.7 - 0.04 * xz[:, 1]
    ground = np.column_stack([xz[:, 0], slope, xz[:, 1]])
    car = np.column_stack([rng.uniform(0, 4, 500), np.zeros(500), rng.uniform(20, 22, 500)])
    car[:, 1] = 1.7 - 0.04 * car[:, 2] - rng.uniform(0, 1.5, 500)
    height = ground_height(np.concatenate([ground, car]).astype(np.float32))
    true = 1.7 - 0.04 * car[:, 2] - car[:, 1]
    inner = (np.abs(xz[:, 0]) < 15) & (xz[:, 1] > 10) & (xz[:, 1] < 55)
    assert np.abs(height[:8000][inner]).mean() < 0.06
    assert np.abs(height[8000:] - true).mean() < 0.1
    assert len(ground_height(np.zeros((0, 3), np.float32))) == 0


def test_features_by_hand() -> None:
    cloud = CameraCloud(np.array([[30.0, 0, 40]], np.float32), np.array([[0.75, 1.0, 1.0]], np.float32))
    names = ("height", "range", "intensity", "source", "semantic")
    features = point_features(cloud, np.array([1.0], np.float32), names)
    assert features[0].tolist() == pytest.approx([0.5, 0.25, 0.25, 1.0, 1.0])


def test_a_missing_column_is_named() -> None:
    cloud = CameraCloud(np.zeros((1, 3), np.float32), np.zeros((1, 1), np.float32))
    with pytest.raises(ValueError, match="feature 'source': expected frames with at least 5 columns"):
        point_features(cloud, np.zeros(1, np.float32), ("source",))
    with pytest.raises(ValueError, match="unknown point feature 'colour'"):
        point_features(cloud, np.zeros(1, np.float32), ("colour",))


def test_network_input_shapes_and_seed(rng) -> None:
    cloud = camera_cloud(box_frame(0)[0])
    height = ground_height(cloud.xyz)
    settings = InputSettings(512, "balanced", ("height", "range"), cloud=1000)
    points, full = network_input(cloud, height, settings, np.random.default_rng(3))
    again = network_input(cloud, height, settings, np.random.default_rng(3))
    assert points.shape == (512, 5)
    assert full.shape == (1000, 5)
    assert points.dtype == full.dtype == np.float32
    assert (points == again[0]).all()
    assert (full == again[1]).all()
    with pytest.raises(ValueError, match="unknown sampler"):
        network_input(cloud, height, InputSettings(512, "grid"), rng)


def test_mirroring_twice_returns_the_cloud() -> None:
    cloud = camera_cloud(box_frame(0)[0])
    assert (mirrored(mirrored(cloud)).xyz == cloud.xyz).all()
    assert (mirrored(cloud).xyz[:, 0] == -cloud.xyz[:, 0]).all()


def label(kind: str, location: tuple[float, float, float]) -> KittiObject:
    return KittiObject(kind, 0, 0, 0, (0, 0, 10, 10), (1.5, 1.6, 4.0), location, 0.1)


def test_training_boxes_by_class_and_place() -> None:
    objects = [
        label("Car", (1, 1.5, 20)),
        label("Van", (5, 1.5, 20)),
        label("Person_sitting", (1, 1.5, 30)),
        label("Truck", (1, 1.5, 40)),
        label("Car", (1, 1.5, 71)),
        label("DontCare", (-1000, -1000, -1000)),
    ]
    truth = truth_boxes(objects, ("Car", "Pedestrian"))
    assert truth.classes.tolist() == [1, 1, 2]
    assert truth.boxes[:, 0].tolist() == [1, 5, 1]
    assert truth_boxes(objects, ("Car",)).classes.tolist() == [1, 1]
    assert truth_boxes([], ("Car",)).boxes.shape == (0, 7)


@pytest.mark.real_data
def test_real_frame_keeps_most_points_of_its_cars(kitti_object) -> None:
    from detection.ops import points_in_boxes

    folder, name = kitti_object / "training", "000008"
    lines = [line.split() for line in (folder / "calib" / f"{name}.txt").read_text().splitlines() if line]
    values = {line[0].rstrip(":"): np.array(line[1:], dtype=float) for line in lines}
    rectify, to_camera = np.eye(4), np.eye(4)
    rectify[:3, :3] = values["R0_rect"].reshape(3, 3)
    to_camera[:3] = values["Tr_velo_to_cam"].reshape(3, 4)
    points = np.fromfile(folder / "velodyne" / f"{name}.bin", np.float32).reshape(-1, 4)
    frame = PointFrame(points, rectify @ to_camera, values["P2"].reshape(3, 4), (375, 1242), name)
    cloud = camera_cloud(frame)
    assert 15000 < len(cloud.xyz) < 22000
    cars = [o for o in parse_lines((folder / "label_2" / f"{name}.txt").read_text()) if o.type == "Car"]
    inside = points_in_boxes(cloud.xyz, boxes_of(cars).values)
    assert (inside.sum(axis=1) > 20).sum() >= 4
    height = ground_height(cloud.xyz)[inside.any(axis=0)]
    assert np.percentile(height, 1) > -0.3
    assert 1.0 < np.percentile(height, 99) < 2.2
