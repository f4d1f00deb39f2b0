"""LiDAR, completed depth and augmented cloud of a frame, as the stages read them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError
from pipeline.data import Frame
from pipeline.data.depth_png import read_depth_png
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.preset import uses_raw_lidar

if TYPE_CHECKING:
    from completion.types import CompletedDepth
    from pipeline.pointcloud.presets import AugmentSettings


def lidar_of(frame: Frame) -> NDArray[np.float32]:
    """(N, 4) LiDAR points; where sparse depth is stored instead (Virtual KITTI 2), its pixels back-projected."""
    if frame.has("points"):
        return frame.points
    from pipeline.geometry.back_project import back_project

    sparse = frame.sparse_depth
    points = back_project(sparse, frame.calibration, sparse > 0).points
    return np.column_stack([points, np.zeros(len(points))]).astype(np.float32)


def lidar_parts(frame: Frame) -> tuple[str, ...]:
    """The parts that `lidar_of` reads."""
    return ("points" if frame.has("points") else "sparse_depth", "calibration")


def completed_depth(config: Config, frame: Frame, files: FrameOutputs) -> CompletedDepth:
    """Completed depth of this run, or of the folder `augment.depth_from`."""
    from completion.types import CompletedDepth

    if config.augment.depth_from is None:
        return files.read_completed()
    from pipeline.pointcloud.depth_source import placed_bottom_centre

    path = Path(config.augment.depth_from) / f"{frame.id}.png"
    depth = read_depth_png(path)
    if not depth.any():
        raise DataError(path, "a depth map with values", "no pixel has a value")
    if depth.shape != tuple(frame.image_size):
        depth = placed_bottom_centre(depth, frame.image_size, path)
    return CompletedDepth(depth)


def with_sigma(completed: CompletedDepth, settings: AugmentSettings) -> CompletedDepth:
    """The completed depth, with surfaces estimated from its local spread when the settings need some it has not."""
    if completed.has_surfaces or not settings.needs_surfaces:
        return completed
    from pipeline.pointcloud.pseudo_sigma import pseudo_sigma

    return pseudo_sigma(completed.depth)


def cloud_of(config: Config, frame: Frame, files: FrameOutputs) -> NDArray[np.float32]:
    """(N, 4 or 5 + C) float32 points for the detector, LiDAR frame."""
    return lidar_of(frame) if uses_raw_lidar(config) else files.read_cloud()
