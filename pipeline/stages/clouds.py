"""The LiDAR and the augmented cloud of a frame, as the stages read them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.data.frame import Frame
from pipeline.data.lidar_like import depth_points
from pipeline.run_folder.frame_outputs import FrameOutputs


def lidar_of(frame: Frame) -> NDArray[np.float32]:
    """(N, 4) LiDAR points; where sparse depth is stored instead (Virtual KITTI 2), its pixels back-projected."""
    if frame.has("points"):
        return frame.points
    return depth_points(frame.sparse_depth, frame.calibration)


def lidar_parts(frame: Frame) -> tuple[str, ...]:
    """The parts that `lidar_of` reads."""
    stored = ("points",) if frame.has("points") else ("points", *frame.sources("sparse_depth"))
    return *stored, "calibration"


def cloud_of(raw_lidar: bool, frame: Frame, files: FrameOutputs) -> NDArray[np.float32]:
    """(N, 4 or 5 + C) float32 points for the detector, LiDAR frame."""
    return lidar_of(frame) if raw_lidar else files.read_cloud()
