"""Clouds of boxes on flat ground, made in memory: enough for a network to learn cars from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detection.boxes import observation_angle, project_to_image
from detection.kitti_format import KittiObject
from detection.types import Boxes3D, PointFrame

T_CAM_VELO = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
P2 = np.array([[721.5, 0, 609.6, 44.86], [0, 721.5, 172.9, 0.2163], [0, 0, 1, 0.002746]])
IMAGE_SIZE = (375, 1242)
GROUND_Y = 1.7


def surface_points(box: NDArray[np.float64], count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """(count, 3) points on the four walls and the top of a box (7,), camera frame."""
    h, w, l = box[3:6]
    local = rng.uniform(-0.5, 0.5, (count, 3)) * [l, h, w]
    face = rng.integers(5, size=count)
    local[face == 0, 0], local[face == 1, 0] = l / 2, -l / 2
    local[face == 2, 2], local[face == 3, 2] = w / 2, -w / 2
    local[face == 4, 1] = -h / 2
    cos, sin = np.cos(box[6]), np.sin(box[6])
    x = local[:, 0] * cos + local[:, 2] * sin
    z = -local[:, 0] * sin + local[:, 2] * cos
    return np.stack([box[0] + x, box[1] - h / 2 + local[:, 1], box[2] + z], axis=1)


def place_cars(count: int, rng: np.random.Generator, farthest: float = 25.0) -> NDArray[np.float64]:
    """(count, 7) boxes of car size, from 8 m to `farthest` ahead, at least 6 m apart, in view of the camera."""
    boxes: list[NDArray[np.float64]] = []
    while len(boxes) < count:
        z = rng.uniform(8, farthest)
        x = rng.uniform(-0.6, 0.6) * z
        if all(np.hypot(x - other[0], z - other[2]) > 6 for other in boxes):
            size = np.array([1.53, 1.63, 3.9]) * rng.uniform(0.9, 1.1)
            boxes.append(np.array([x, GROUND_Y, z, *size, rng.uniform(-np.pi, np.pi)]))
    return np.array(boxes)


def box_frame(index: int, cars: int = 6, points_per_car: int = 250) -> tuple[PointFrame, list[KittiObject]]:
    """A frame of ground and cars with its labels, all of it in view; the same for the same index."""
    rng = np.random.default_rng([7, index])
    boxes = place_cars(cars, rng)
    ground = np.stack([rng.uniform(-30, 30, 5000), np.full(5000, GROUND_Y), rng.uniform(3, 50, 5000)], axis=1)
    xyz = np.concatenate([ground, *(surface_points(box, points_per_car, rng) for box in boxes)])
    velo = (xyz - T_CAM_VELO[:3, 3]) @ T_CAM_VELO[:3, :3]
    intensity = rng.uniform(0, 1, (len(velo), 1))
    points = np.concatenate([velo, intensity], axis=1).astype(np.float32)
    frame = PointFrame(points, T_CAM_VELO, P2, IMAGE_SIZE, f"{index:06d}")
    return frame, car_labels(boxes)


def car_labels(boxes: NDArray[np.float64]) -> list[KittiObject]:
    """Fully visible, untruncated cars."""
    rectangles = project_to_image(Boxes3D(boxes), P2, IMAGE_SIZE)
    alphas = observation_angle(Boxes3D(boxes))
    found = []
    for (x, y, z, h, w, l, ry), (x1, y1, x2, y2), alpha in zip(boxes.tolist(), rectangles.tolist(), alphas.tolist()):
        found.append(KittiObject("Car", 0.0, 0, alpha, (x1, y1, x2, y2), (h, w, l), (x, y, z), ry))
    return found


class BoxFrames:
    """`count` box frames as a source for training."""

    def __init__(self, count: int, cars: int = 6) -> None:
        self.frames = [box_frame(index, cars) for index in range(count)]

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> tuple[PointFrame, list[KittiObject]]:
        return self.frames[index]
