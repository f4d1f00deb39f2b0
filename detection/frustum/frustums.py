"""The points behind a region of the image, turned so that the frustum's middle looks ahead.

Rectified camera frame: x right, y down, z forward. Source: Qi et al. 2018, section 4.1, and the published preparation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detection.frustum.regions import Box, Region
from detection.types import PointFrame

Array = NDArray[np.float64]

LEAST_DISTANCE = 2.0  # metres ahead of the LiDAR
LEAST_HEIGHT = 25.0  # pixels of a 2D box
LEAST_POINTS = 5  # of a frustum that is looked into
_MIDDLE_DEPTH = 20.0  # metres at which the middle of a box is taken


@dataclass(frozen=True)
class ViewedCloud:
    """The points of a frame that the image sees.

    xyz     (N, 3) rectified camera, metres     columns  (N, C) what stands beside x y z (intensity first)
    pixels  (N, 2) u, v
    """

    xyz: Array
    columns: NDArray[np.float32]
    pixels: Array


@dataclass(frozen=True)
class Frustum:
    """The points of a region.

    points    (N, 3 + C) float32, rotated by `rotation` about the vertical axis
    rotation  radians from the camera's axis to the frustum's
    """

    points: NDArray[np.float32]
    rotation: float


def viewed_cloud(frame: PointFrame) -> ViewedCloud:
    """Points more than 2 m ahead of the LiDAR that fall into the image, 0 <= u < W and 0 <= v < H."""
    points = frame.points.astype(np.float64)
    xyz = points[:, :3] @ frame.T_cam_velo[:3, :3].T + frame.T_cam_velo[:3, 3]
    projected = xyz @ frame.P2[:, :3].T + frame.P2[:, 3]
    ahead = (points[:, 0] > LEAST_DISTANCE) & (projected[:, 2] > 0)
    pixels = projected[:, :2] / np.where(ahead, projected[:, 2], 1.0)[:, None]
    height, width = frame.image_size
    keep = ahead & (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
    return ViewedCloud(xyz[keep], frame.points[keep, 3:], pixels[keep])


def frustum_rotation(bbox: Box, P2: Array) -> float:
    """Radians by which a frustum is turned: pi / 2 - atan2(z, x) of the box's middle, back-projected at 20 m."""
    middle = (bbox[0] + bbox[2]) / 2
    x = (middle - P2[0, 2]) * _MIDDLE_DEPTH / P2[0, 0] - P2[0, 3] / P2[0, 0]
    return float(np.pi / 2 - np.arctan2(_MIDDLE_DEPTH, x))


def rotate(points: NDArray[np.floating], rotation: float) -> Array:
    """(..., 3) turned about the vertical axis: x' = x cos - z sin, z' = x sin + z cos."""
    turned = np.array(points, dtype=np.float64)
    cos, sin = np.cos(rotation), np.sin(rotation)
    x, z = points[..., 0], points[..., 2]
    turned[..., 0], turned[..., 2] = x * cos - z * sin, x * sin + z * cos
    return turned


def points_in_region(cloud: ViewedCloud, region: Region) -> NDArray[np.int64]:
    """Indices of the points with x1 <= u < x2 and y1 <= v < y2, or the nearest pixel in the mask if there is one."""
    u, v = cloud.pixels.T
    x1, y1, x2, y2 = region.bbox
    if region.pixels is None:
        return np.flatnonzero((u >= x1) & (u < x2) & (v >= y1) & (v < y2))
    height, width = region.pixels.shape
    columns, rows = (np.rint(values).astype(np.int64) for values in (u, v))
    return np.flatnonzero(region.pixels[rows.clip(0, height - 1), columns.clip(0, width - 1)])


def cut_frustum(cloud: ViewedCloud, region: Region, P2: Array, channels: int) -> tuple[Frustum, NDArray[np.int64]]:
    """The frustum of a region, and which points of the cloud it holds.

    channels  3: x y z; 4: and the first column. Raises ValueError for 4 when the cloud has no column.
    """
    if channels == 4 and cloud.columns.shape[1] == 0:
        raise ValueError("expected points with an intensity (x y z intensity), got x y z; take a network of 3 channels")
    index = points_in_region(cloud, region)
    rotation = frustum_rotation(region.bbox, P2)
    xyz = rotate(cloud.xyz[index], rotation)
    return Frustum(np.hstack([xyz, cloud.columns[index, : channels - 3]]).astype(np.float32), rotation), index


def is_looked_into(region: Region, frustum: Frustum) -> bool:
    """Boxes lower than 25 px and frustums of fewer than 5 points are not."""
    return region.bbox[3] - region.bbox[1] >= LEAST_HEIGHT and len(frustum.points) >= LEAST_POINTS
