"""Labelled boxes in the LiDAR frame, and the points inside."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detection.boxes import to_lidar
from detection.types import Boxes3D
from pipeline.geometry.calibration import Calibration

Array = NDArray[np.float64]


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
