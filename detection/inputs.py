"""The border between a LiDAR cloud and the networks: camera frame, field of view, range, and point features."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from auglidar_base.errors import SettingsError
from detection import sampling
from detection.kitti_format import KittiObject
from detection.types import PointFrame

Array = NDArray[np.float64]

# PointRCNN's PC_AREA_SCOPE: x right, y down, z forward in metres, borders included.
AREA = ((-40.0, 40.0), (-1.0, 3.0), (0.0, 70.4))

# Classes that count as another in training (INCLUDE_SIMILAR_TYPE), unless a detector has them as its own.
SIMILAR = {"Van": "Car", "Person_sitting": "Pedestrian"}

FEATURES = ("height", "range", "intensity", "source", "semantic")


@dataclass(frozen=True)
class CameraCloud:
    """The points of a frame that a detector may see.

    xyz      (N, 3) float32 rectified camera frame, metres
    columns  (N, C) float32 columns of the frame after x y z
    """

    xyz: NDArray[np.float32]
    columns: NDArray[np.float32]


def camera_cloud(frame: PointFrame) -> CameraCloud:
    """Points inside the image (of this frame's own size), in front of the camera and within `AREA`."""
    xyz = _camera_xyz(frame)
    inside = openpcdet_field_of_view(xyz, frame.P2, frame.image_size)
    for axis, (low, high) in enumerate(AREA):
        inside &= (xyz[:, axis] >= low) & (xyz[:, axis] <= high)
    return CameraCloud(xyz[inside].astype(np.float32), frame.points[inside, 3:])


def ground_height(xyz: NDArray[np.float32], cell: float = 2.0, window: int = 5) -> NDArray[np.float32]:
    """(N,) metres above the local ground.

    xyz  (N, 3) camera frame (y down). The lowest 5 % of each cell of `cell` metres give a height map; a morphological
    opening over `window` cells takes away what stands on the ground and leaves slopes as they are.
    """
    from scipy import ndimage

    if not len(xyz):
        return np.zeros(0, dtype=np.float32)
    up = -xyz[:, 1].astype(np.float64)
    (x_low, x_high), _, (z_low, z_high) = AREA
    shape = (int((x_high - x_low) / cell) + 2, int((z_high - z_low) / cell) + 2)
    across = np.clip((xyz[:, 0] - x_low) / cell, 0, shape[0] - 1.001)
    ahead = np.clip((xyz[:, 2] - z_low) / cell, 0, shape[1] - 1.001)
    flat = across.astype(np.int64) * shape[1] + ahead.astype(np.int64)
    order = np.lexsort((up, flat))
    cells, start, count = np.unique(flat[order], return_index=True, return_counts=True)
    lowest = np.full(shape[0] * shape[1], np.inf)
    lowest[cells] = up[order][start + (0.05 * count).astype(np.int64)]
    eroded = ndimage.minimum_filter(lowest.reshape(shape), size=window, mode="constant", cval=np.inf)
    eroded = np.where(np.isfinite(eroded), eroded, -np.inf)
    opened = ndimage.maximum_filter(eroded, size=window, mode="constant", cval=-np.inf)
    opened = np.where(np.isfinite(opened), opened, np.median(up[order][start]))
    ground = ndimage.map_coordinates(opened, [across - 0.5, ahead - 0.5], order=1, mode="nearest")
    return np.asarray(up - ground, dtype=np.float32)


def point_features(cloud: CameraCloud, height: NDArray[np.float32], names: Sequence[str]) -> NDArray[np.float32]:
    """(N, len(names)) features, scaled to about [-1, 1].

    height     metres above ground / 2, clipped to [-0.5, 2]       range   horizontal distance / 40 m - 1
    intensity  column 3 of the frame - 0.5 (PointRCNN)             source  column 4: 0 measured, 1 completed
    semantic   the frame's last column, a 0 / 1 flag (thesis 5.3)
    Raises ValueError naming the column a frame lacks.
    """
    columns: list[NDArray[Any]] = []
    for name in names:
        if name == "height":
            columns.append(np.clip(height / 2, -0.5, 2.0))
        elif name == "range":
            columns.append(np.hypot(cloud.xyz[:, 0], cloud.xyz[:, 2]) / 40 - 1)
        else:
            columns.append(_frame_column(cloud, name))
    return np.stack(columns, axis=1).astype(np.float32) if columns else np.zeros((len(cloud.xyz), 0), np.float32)


def _frame_column(cloud: CameraCloud, name: str) -> NDArray[np.float32]:
    position = {"intensity": 0, "source": 1, "semantic": 2}
    if name not in position:
        raise SettingsError(f"unknown point feature {name!r}; known are {', '.join(FEATURES)}")
    have = cloud.columns.shape[1]
    if have <= position[name]:
        raise SettingsError(
            f"feature '{name}': expected frames with at least {position[name] + 4} columns (x y z intensity source "
            f"semantic), got {have + 3}; detect on augmented clouds or choose a detector without this feature"
        )
    if name == "semantic":
        return cloud.columns[:, -1]
    return cloud.columns[:, position[name]] - (0.5 if name == "intensity" else 0.0)


@dataclass(frozen=True)
class TruthBoxes:
    """boxes (G, 7) float64 camera form; classes (G,) int64, 1 = first class of the detector."""

    boxes: Array
    classes: NDArray[np.int64]


def truth_boxes(objects: Iterable[KittiObject], classes: Sequence[str]) -> TruthBoxes:
    """Training boxes: objects of the classes whose bottom centre is in `AREA`.

    A class the detector lacks may count as another: Van as Car, see `SIMILAR`.

    No difficulty filter: occluded, truncated and tiny objects are positives, as in PointRCNN.
    """
    rows, labels = [], []
    for item in objects:
        name = item.type if item.type in classes else SIMILAR.get(item.type, item.type)
        in_area = all(low <= value <= high for value, (low, high) in zip(item.location, AREA))
        if name in classes and in_area and min(item.size) > 0:
            rows.append((*item.location, *item.size, item.ry))
            labels.append(classes.index(name) + 1)
    return TruthBoxes(np.array(rows, dtype=np.float64).reshape(-1, 7), np.array(labels, dtype=np.int64))


@dataclass(frozen=True)
class InputSettings:
    """How a cloud becomes the input of a network.

    points    points of the first stage
    sampler   "near_far" (PointRCNN), "uniform" (thesis, dense clouds) or "balanced" (see `detection.sampling`); "all"
              points of the frame for the voxel detectors (see `detection.lidar_inputs`)
    features  columns beside x y z, of `FEATURES`
    cloud     most points kept of the full cloud for the second stage; 0 when it does not use it
    frame     "camera", or "lidar" for networks of OpenPCDet: input and output boxes are then in the LiDAR frame
    """

    points: int = 16384
    sampler: str = "near_far"
    features: tuple[str, ...] = ()
    cloud: int = 0
    frame: str = "camera"


def network_input(
    cloud: CameraCloud, height: NDArray[np.float32], settings: InputSettings, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Sampled points (settings.points, 3 + E) and the shuffled full cloud (M, 3 + E), both float32 in the camera frame.

    Raises ValueError for an empty cloud and for features the frame has no column for.
    """
    if settings.sampler == "near_far":
        index = sampling.near_far_sample(cloud.xyz, settings.points, rng)
    elif settings.sampler == "uniform":
        index = sampling.uniform_sample(cloud.xyz, settings.points, rng)
    elif settings.sampler == "balanced":
        index = sampling.balanced_sample(cloud.xyz, height, settings.points, rng)
    else:
        raise SettingsError(f"unknown sampler {settings.sampler!r}; known are near_far, uniform, balanced")
    rows = np.concatenate([cloud.xyz, point_features(cloud, height, settings.features)], axis=1)
    full = rng.permutation(len(rows))[: settings.cloud]
    return rows[index], rows[full]


def mirrored(cloud: CameraCloud) -> CameraCloud:
    """The cloud reflected in the plane x = 0."""
    return CameraCloud(cloud.xyz * np.array([-1, 1, 1], dtype=np.float32), cloud.columns)


def in_view_openpcdet(frame: PointFrame) -> NDArray[np.bool_]:
    """(N,) whether OpenPCDet and PointRCNN would keep a point of the frame: see `openpcdet_field_of_view`."""
    return openpcdet_field_of_view(_camera_xyz(frame), frame.P2, frame.image_size)


def _camera_xyz(frame: PointFrame) -> Array:
    return frame.points[:, :3].astype(np.float64) @ frame.T_cam_velo[:3, :3].T + frame.T_cam_velo[:3, 3]


def openpcdet_field_of_view(xyz: Array, P2: Array, image_size: tuple[int, int]) -> NDArray[np.bool_]:
    """(N,) True for points (N, 3) of the rectified camera frame, metres, that OpenPCDet's and PointRCNN's loaders keep.

    image_size  (height, width) in pixels
    This is the border the networks were trained behind (OpenPCDet's `get_fov_flag`, PointRCNN's `get_valid_flag`): u
    and v are not rounded, 0 <= u < width, 0 <= v < height, and are divided by z of the rectified frame instead of the
    homogeneous coordinate (2.7 mm apart in KITTI); the depth is the latter less P2[2, 3] and may be 0.
    """
    projected = xyz @ P2[:, :3].T + P2[:, 3]
    height, width = image_size
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = projected[:, 0] / xyz[:, 2], projected[:, 1] / xyz[:, 2]
        return (projected[:, 2] - P2[2, 3] >= 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)


# OpenPCDet's POINT_CLOUD_RANGE of x and y; its mask leaves z alone.
LIDAR_AREA = ((0.0, 70.4), (-40.0, 40.0))


def lidar_input(frame: PointFrame, count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """(count, 4) x y z intensity in the LiDAR frame as OpenPCDet's KITTI models take them; (0, 4) when none is visible.

    Inside the image and `LIDAR_AREA`; near and far are told apart by the 3D distance (40 m); raw reflectance.
    """
    points = frame.points[:, :4]
    if points.shape[1] < 4:
        raise ValueError(f"{frame.id}: expected points x y z intensity, got {points.shape[1]} columns")
    keep = in_view_openpcdet(frame)
    for axis, (low, high) in enumerate(LIDAR_AREA):
        keep &= (points[:, axis] >= low) & (points[:, axis] <= high)
    points = points[keep]
    if not len(points):
        return points
    distance = np.linalg.norm(points[:, :3], axis=1)
    ranked = np.column_stack([points[:, :2], distance])
    return points[sampling.near_far_sample(ranked, count, rng)]
