"""Back-projection of a depth map into the LiDAR frame (thesis section 5.3.1)."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeline.data.calibration import Calibration
from pipeline.errors import DataError
from pipeline.pointcloud.clouds import DenseCloud


def back_project(depth: NDArray[np.float32], calibration: Calibration, keep: NDArray[np.bool_]) -> DenseCloud:
    """(H, W) depth in metres -> the points of the pixels that `keep` marks and that have a value, in row order.

    With P2 = [fu 0 cu p0; 0 fv cv p1; ...] the rectified camera point of pixel (u, v) is
    x = (u - cu) / fu * z - p0 / fu, y = (v - cv) / fv * z - p1 / fv, z = depth: the last terms are the baseline of the
    colour camera (KITTI devkit). It is then moved by T_velo_cam. All in float64, rounded to float32 once at the end.

    Raises DataError for a map of another shape than `keep` and for NaN, infinite or negative depth.
    """
    if depth.ndim != 2 or depth.shape != keep.shape:
        raise DataError("back-projection", f"an (H, W) depth map like the {keep.shape} mask", f"shape {depth.shape}")
    depth = np.ascontiguousarray(depth, dtype=np.float32)
    height, width = depth.shape
    P2 = calibration.P2
    slope_u = (np.arange(width) - P2[0, 2]) / P2[0, 0]
    slope_v = (np.arange(height) - P2[1, 2]) / P2[1, 1]
    baseline = np.array([-P2[0, 3] / P2[0, 0], -P2[1, 3] / P2[1, 1]])
    kept = np.ascontiguousarray(keep, dtype=np.bool_)
    count = _count(depth, kept)
    if count < 0:
        raise DataError("back-projection", "finite depth >= 0 m, 0 = no value", "NaN, infinite or negative depth")
    points, pixels = np.empty((count, 3), np.float32), np.empty(count, np.int32)
    _back_project(depth, kept, slope_u, slope_v, baseline, calibration.T_velo_cam, points, pixels)
    return DenseCloud(points, pixels)


@njit(cache=True, nogil=True)
def _count(depth, keep):  # type: ignore[no-untyped-def]
    """Marked pixels with a value, or -1 when any value of the map is not usable."""
    count, wrong = 0, 0
    for z, k in zip(depth.ravel(), keep.ravel()):
        count += int(k & (z > 0))
        wrong += int(not (z >= 0 and z < np.inf))
    return -1 if wrong else count


@njit(cache=True, nogil=True)
def _back_project(depth, keep, slope_u, slope_v, baseline, T_velo_cam, points, pixels):  # type: ignore[no-untyped-def]
    height, width = depth.shape
    T = T_velo_cam
    at = 0
    for row in range(height):
        for column in range(width):
            if not (keep[row, column] and depth[row, column] > 0):
                continue
            z = np.float64(depth[row, column])
            x = slope_u[column] * z + baseline[0]
            y = slope_v[row] * z + baseline[1]
            points[at, 0] = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            points[at, 1] = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            points[at, 2] = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            pixels[at] = row * width + column
            at += 1
