"""Which pixel each raw LiDAR return falls on."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.calibration import Calibration

_MIN_DEPTH = 0.5  # metres; nearer returns are the car itself


def lidar_pixels(
    points: NDArray[np.float32], calibration: Calibration, image_size: tuple[int, int]
) -> NDArray[np.int64]:
    """(N, 3+) LiDAR points -> (N,) row * width + column of the nearest pixel, -1 outside the image or behind it."""
    height, width = image_size
    pixels = np.full(len(points), -1, np.int64)
    ahead = np.flatnonzero(calibration.velo_to_cam(points)[:, 2] > _MIN_DEPTH)
    where, _ = calibration.cam_to_image(calibration.velo_to_cam(points[ahead]))
    column, row = np.rint(where).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixels[ahead[inside]] = (row * width + column)[inside].astype(np.int64)
    return pixels


def value_at(pixels: NDArray[np.int64], values: NDArray[Any]) -> NDArray[Any]:
    """(N,) values of an (H, W) map at `lidar_pixels`, 0 for points outside the image."""
    return np.where(pixels >= 0, values.reshape(-1)[pixels], np.zeros((), values.dtype))
