"""Which pixel each raw LiDAR return falls on."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeline.geometry.calibration import Calibration

_MIN_DEPTH = 0.5  # metres; nearer returns are the car itself


def lidar_pixels(
    points: NDArray[np.float32], calibration: Calibration, image_size: tuple[int, int]
) -> NDArray[np.int64]:
    """(N, 3+) LiDAR points -> (N,) row * width + column of the nearest pixel, -1 outside the image or behind it."""
    pixels = np.empty(len(points), np.int64)
    _lidar_pixels(points, calibration.P2 @ calibration.T_cam_velo, calibration.T_cam_velo, image_size, pixels)
    return pixels


def value_at(pixels: NDArray[np.int64], values: NDArray[Any]) -> NDArray[Any]:
    """(N,) values of an (H, W) map at `lidar_pixels`, 0 for points outside the image."""
    return np.where(pixels >= 0, values.reshape(-1)[pixels], np.zeros((), values.dtype))


@njit(cache=True, nogil=True)
def _lidar_pixels(points, P_velo, T_cam_velo, image_size, pixels):  # type: ignore[no-untyped-def]
    height, width = image_size
    P, T = P_velo, T_cam_velo
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        pixels[i] = -1
        if T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3] > _MIN_DEPTH:
            scale = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
            column = np.rint((P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / scale)
            row = np.rint((P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / scale)
            if (column >= 0) & (column < width) & (row >= 0) & (row < height):
                pixels[i] = np.int64(row) * width + np.int64(column)
