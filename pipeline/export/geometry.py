"""Pixels of depth maps; LiDAR points in the image and in boxes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detection.boxes import to_lidar
from detection.types import Boxes3D
from pipeline.geometry.calibration import Calibration

Array = NDArray[np.float64]


def depth_pixels(depth: NDArray[np.float32]) -> tuple[Array, Array, Array]:
    """(u, v, depth) of the pixels with a value, row by row."""
    v, u = np.nonzero(depth)
    return u.astype(np.float64), v.astype(np.float64), depth[v, u].astype(np.float64)


def in_image(points: NDArray[np.floating], calibration: Calibration, window: tuple[int, int]) -> NDArray[np.bool_]:
    """(N,) True for LiDAR points in front of the camera that project into a window (height, width) from the corner."""
    pixels, depth = calibration.cam_to_image(calibration.velo_to_cam(points))
    height, width = window
    inside = (pixels[:, 0] >= 0) & (pixels[:, 0] < width) & (pixels[:, 1] >= 0) & (pixels[:, 1] < height)
    return np.asarray(inside & (depth > 0))


def boxes_in_lidar(boxes: Boxes3D, calibration: Calibration) -> Array:
    """(N, 7) x y z (centre) l w h heading in the LiDAR frame, heading = -(ry + pi/2)."""
    return to_lidar(boxes, calibration.T_velo_cam)


def points_in_box(points: NDArray[np.floating], box: Array) -> NDArray[np.bool_]:
    """(N,) True for points inside one LiDAR box (7,), faces included."""
    local = np.asarray(points[:, :3], dtype=np.float64) - box[:3]
    cos, sin = np.cos(box[6]), np.sin(box[6])
    along, across = local[:, 0] * cos + local[:, 1] * sin, -local[:, 0] * sin + local[:, 1] * cos
    inside = (np.abs(along) <= box[3] / 2) & (np.abs(across) <= box[4] / 2) & (np.abs(local[:, 2]) <= box[5] / 2)
    return np.asarray(inside)
