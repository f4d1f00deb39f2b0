"""Geometry of 3D boxes in the rectified camera frame (x right, y down, z forward), numpy and float64.

The conventions are KITTI's: location = centre of the bottom face, ry about +y, ry = 0 faces +x. A point (xl, zl) of the
box frame lies at x = xl cos(ry) + zl sin(ry), z = -xl sin(ry) + zl cos(ry) of the scene.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detection.types import Boxes3D

Array = NDArray[np.float64]

# Signs of (l, w) for the four corners of a face, in the order of the KITTI devkit.
_CORNER_L = np.array([1, 1, -1, -1, 1, 1, -1, -1]) / 2
_CORNER_W = np.array([1, -1, -1, 1, 1, -1, -1, 1]) / 2
_CORNER_UP = np.array([0, 0, 0, 0, 1, 1, 1, 1])


def wrap_angle(angle: Array | float) -> Array:
    """Angle(s) in radians moved into [-pi, pi)."""
    return np.asarray((np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi)


def corners(boxes: Boxes3D) -> Array:
    """(N, 8, 3) corners in metres, rectified camera frame; the bottom face first."""
    x, y, z, h, w, l, ry = (column[:, None] for column in boxes.values.T)
    along, across = l * _CORNER_L, w * _CORNER_W
    cos, sin = np.cos(ry), np.sin(ry)
    return np.stack([x + along * cos + across * sin, y - h * _CORNER_UP, z - along * sin + across * cos], axis=-1)


def project_to_image(boxes: Boxes3D, P2: Array, image_size: tuple[int, int] | None = None) -> Array:
    """(N, 4) x1 y1 x2 y2: the pixel rectangle round the eight projected corners.

    image_size  (height, width): clip to [0, W-1] x [0, H-1] as KITTI result files are
    Corners behind the camera are moved to 1 cm in front of it, so that a car beside the camera keeps a sensible box.
    """
    points = corners(boxes)
    homogeneous = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=-1) @ np.asarray(P2).T
    depth = np.maximum(homogeneous[..., 2:3], 0.01)
    pixels = homogeneous[..., :2] / depth
    rectangles = np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=-1)
    if image_size is not None:
        height, width = image_size
        rectangles[:, 0::2] = rectangles[:, 0::2].clip(0, width - 1)
        rectangles[:, 1::2] = rectangles[:, 1::2].clip(0, height - 1)
    return rectangles


def observation_angle(boxes: Boxes3D) -> Array:
    """(N,) alpha in radians in [-pi, pi): the heading as the camera sees it, ry - atan2(x, z)."""
    return wrap_angle(boxes.ry - np.arctan2(boxes.values[:, 0], boxes.values[:, 2]))


def to_lidar(boxes: Boxes3D, T_velo_cam: Array) -> Array:
    """(N, 7) x y z (geometric centre), l, w, h, heading in the LiDAR frame, heading counter-clockwise from +x.

    heading = -(ry + pi/2), the OpenPCDet convention.
    """
    x, y, z, h, w, l, ry = boxes.values.T
    centre = np.stack([x, y - h / 2, z, np.ones_like(x)], axis=-1) @ np.asarray(T_velo_cam).T
    return np.column_stack([centre[:, :3], l, w, h, wrap_angle(-(ry + np.pi / 2))])


def from_lidar(boxes_lidar: Array, T_cam_velo: Array) -> Boxes3D:
    """Inverse of `to_lidar`: (N, 7) x y z l w h heading (LiDAR frame, geometric centre) -> Boxes3D."""
    boxes_lidar = np.asarray(boxes_lidar, dtype=np.float64).reshape(-1, 7)
    x, y, z, l, w, h, heading = boxes_lidar.T
    centre = np.stack([x, y, z, np.ones_like(x)], axis=-1) @ np.asarray(T_cam_velo).T
    ry = wrap_angle(-heading - np.pi / 2)
    return Boxes3D(np.column_stack([centre[:, 0], centre[:, 1] + h / 2, centre[:, 2], h, w, l, ry]))
