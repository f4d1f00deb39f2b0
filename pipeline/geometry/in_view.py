"""Which pixel a LiDAR point falls on, and so whether the camera sees it: the one answer of this project.

A point counts when it is more than 0.5 m in front of camera 0 and the pixel nearest to its projection is in the image,
that is -0.5 <= u <= width - 0.5 (pixel centres have whole coordinates, halves go to the even one). The projection is
KITTI's P2 * R0_rect * Tr_velo_to_cam * x, divided by its third coordinate. Where another project's result must be met,
its rule stands under its name in `reference_in_view.py`; tests/pipeline/geometry/test_in_view.py says on which points
they differ.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeline.geometry.calibration import Calibration

MIN_DEPTH = 0.5  # metres; nearer returns are the car itself


def lidar_pixels(
    points: NDArray[np.floating], calibration: Calibration, image_size: tuple[int, int]
) -> NDArray[np.int64]:
    """(N, 3+) LiDAR points -> (N,) row * width + column of the nearest pixel, -1 outside the image or behind it."""
    return pixels_and_depth(points, calibration, image_size)[0]


def pixels_and_depth(
    points: NDArray[np.floating], calibration: Calibration, image_size: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """`lidar_pixels`, and (N,) depth of the points in metres (z of camera 0, negative behind it)."""
    pixels, depth = np.empty(len(points), np.int64), np.empty(len(points))
    _lidar_pixels(points, calibration.P2 @ calibration.T_cam_velo, calibration.T_cam_velo, image_size, pixels, depth)
    return pixels, depth


def in_view(points: NDArray[np.floating], calibration: Calibration, image_size: tuple[int, int]) -> NDArray[np.bool_]:
    """(N,) whether a LiDAR point (N, 3+) falls on a pixel of the (height, width) image."""
    return lidar_pixels(points, calibration, image_size) >= 0


def value_at(pixels: NDArray[np.int64], values: NDArray[Any]) -> NDArray[Any]:
    """(N,) values of an (H, W) map at `lidar_pixels`, 0 for points outside the image."""
    return np.where(pixels >= 0, values.reshape(-1)[pixels], np.zeros((), values.dtype))


@njit(cache=True, nogil=True)
def pixel_of(P, x, y, z, height, width):  # type: ignore[no-untyped-def]
    """row * width + column of the pixel nearest to a point (x, y, z) projected by P (3, 4), -1 outside the image.

    For kernels, which test the depth themselves.
    """
    scale = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
    column = np.rint((P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / scale)
    row = np.rint((P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / scale)
    if (column >= 0) & (column < width) & (row >= 0) & (row < height):
        return np.int64(row) * width + np.int64(column)
    return np.int64(-1)


@njit(cache=True, nogil=True)
def _lidar_pixels(points, P_velo, T_cam_velo, image_size, pixels, depth):  # type: ignore[no-untyped-def]
    height, width = image_size
    T = T_cam_velo
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        depth[i] = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        pixels[i] = pixel_of(P_velo, x, y, z, height, width) if depth[i] > MIN_DEPTH else -1
