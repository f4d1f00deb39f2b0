"""A KITTI object folder of a few small frames, written by our own writers: for readers, pipeline and command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from detection.kitti_format import KittiObject
from pipeline.data.frame import Frame
from pipeline.data.kitti_object import write_frame
from pipeline.geometry.calibration import Calibration

HEIGHT, WIDTH = 48, 96
P2 = np.array([[70.0, 0, 48, 3], [0, 70, 20, 0.5], [0, 0, 1, 0.003]])
# x forward, y left, z up -> x right, y down, z forward; the LiDAR 8 cm above and 27 cm behind the camera
T_CAM0_VELO = np.array([[0, -1.0, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])
CALIBRATION = Calibration(P2=P2, R0_rect=np.eye(3), T_cam0_velo=T_CAM0_VELO)


def tiny_frame(index: int) -> Frame:
    """A road 1.7 m below the sensor and a wall of a car's size at 8 to 14 m, seen by 16 rows."""
    rng = np.random.default_rng(index)
    distance = 8.0 + index % 7
    azimuth = np.deg2rad(np.linspace(-30, 30, 90))
    elevation = np.deg2rad(np.linspace(2, -20, 16))
    az, el = (grid.ravel() for grid in np.meshgrid(azimuth, elevation))
    ray = np.column_stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])
    to_ground = np.where(ray[:, 2] < 0, -1.7 / np.minimum(ray[:, 2], -1e-6), 60.0)
    to_wall = distance / ray[:, 0]
    hit = ray * to_wall[:, None]
    on_wall = (np.abs(hit[:, 1]) < 2) & (hit[:, 2] < -0.2) & (to_wall < to_ground)
    reach = np.minimum(np.where(on_wall, to_wall, to_ground), 60.0)
    points = np.column_stack([ray * reach[:, None], rng.uniform(0, 1, len(ray))]).astype(np.float32)
    image = rng.integers(60, 90, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    image[20:36, 36:60] += np.uint8(100)
    depth = np.full((HEIGHT, WIDTH), 60.0, np.float32)
    depth[20:36, 36:60] = distance
    semantics = np.where(depth < 60, 13, 0).astype(np.uint8)
    car = KittiObject("Car", 0.0, 0, 0.0, (36, 20, 60, 36), (1.5, 4.0, 1.6), (0.0, 1.62, distance + 0.5), 0.0)
    return Frame(
        f"{index:06d}",
        {
            "image": lambda: image,
            "points": lambda: points,
            "calibration": lambda: CALIBRATION,
            "labels": lambda: [car],
            "target_depth": lambda: depth,
            "semantics": lambda: semantics,
        },
    )


def write_tiny_kitti(root: Path, frames: int) -> Path:
    """ROOT/training with `frames` frames; returns ROOT."""
    for index in range(frames):
        write_frame(root / "training", tiny_frame(index))
    return root
