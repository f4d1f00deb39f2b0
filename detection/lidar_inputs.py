"""The border of the LiDAR-frame detectors that see every point.

Training scenes are prepared in camera axes (x right, y down, z forward). For these detectors such a scene is the LiDAR
frame itself with its axes renamed, so that augmentation is the same code and the network sees LiDAR coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detection.boxes import from_lidar, to_lidar
from detection.inputs import LIDAR_AREA, CameraCloud, ground_height, in_view_openpcdet, point_features
from detection.types import Boxes3D, PointFrame

Array = NDArray[np.float64]

# Turned axes from LiDAR axes: x right = -y, y down = -z, z forward = x.
_T_AXES_VELO = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def camera_axes_cloud(frame: PointFrame) -> CameraCloud:
    """Points inside the image and `LIDAR_AREA` (x and y; z is free) in turned axes, in the order of the frame."""
    keep = in_view_openpcdet(frame)
    for axis, (low, high) in enumerate(LIDAR_AREA):
        keep &= (frame.points[:, axis] >= low) & (frame.points[:, axis] <= high)
    points = frame.points[keep]
    return CameraCloud(np.stack([-points[:, 1], -points[:, 2], points[:, 0]], axis=1), points[:, 3:])


def camera_axes_boxes(boxes: Array, frame: PointFrame) -> Array:
    """(G, 7) boxes of the rectified camera -> camera form in turned axes."""
    lidar = to_lidar(Boxes3D(boxes), np.linalg.inv(frame.T_cam_velo).astype(np.float64))
    return from_lidar(lidar, _T_AXES_VELO).values


def lidar_boxes(boxes: Array) -> Array:
    """(G, 7) camera form in turned axes -> x y z (centre) l w h heading in the LiDAR frame."""
    return to_lidar(Boxes3D(boxes), _T_AXES_VELO.T)


def from_camera_axes(boxes: Array, frame: PointFrame) -> Boxes3D:
    """Inverse of `camera_axes_boxes`."""
    return from_lidar(lidar_boxes(boxes), frame.T_cam_velo)


def lidar_rows(cloud: CameraCloud, height: NDArray[Any], features: Sequence[str]) -> NDArray[np.float32]:
    """(N, 3 + len(features)) x y z in the LiDAR frame and the features of a cloud in turned axes.

    Features are those of `detection.inputs.point_features`, but the intensity stays raw, as OpenPCDet takes it.
    """
    columns = point_features(cloud, np.asarray(height, dtype=np.float32), features)
    if "intensity" in features:
        columns[:, list(features).index("intensity")] = cloud.columns[:, 0]
    x, y, z = cloud.xyz.T
    return np.column_stack([z, -x, -y, columns]).astype(np.float32)


def all_points(frame: PointFrame, features: Sequence[str]) -> NDArray[np.float32]:
    """(N, 3 + len(features)) every visible point of a frame as the network takes it, in the order of the frame."""
    cloud = camera_axes_cloud(frame)
    height = ground_height(cloud.xyz) if "height" in features else np.zeros(len(cloud.xyz), np.float32)
    return lidar_rows(cloud, height, features)
