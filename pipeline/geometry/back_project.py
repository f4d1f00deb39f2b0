"""Back-projection of a depth map into the LiDAR frame (thesis section 5.3.1).

With P2 = [fu 0 cu p0; 0 fv cv p1; ...] the rectified camera point of pixel (u, v) is
x = (u - cu) / fu * z - p0 / fu, y = (v - cv) / fv * z - p1 / fv, z = depth: the last terms are the baseline of the
colour camera (KITTI devkit). In the LiDAR frame, with T_velo_cam = [R | t], that is

    depth * (R @ ((u - cu) / fu, (v - cv) / fv, 1)) + (R @ (-p0 / fu, -p1 / fv, 0) + t)

a direction per pixel and one origin, the colour camera's. In float64, rounded to float32 once at the end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeline.base.errors import DataError
from pipeline.geometry.calibration import Calibration
from pipeline.geometry.clouds import DenseCloud


@dataclass(frozen=True)
class PixelRays:
    """What back-projection needs of a calibration.

    slope_u  (W,) float64 (u - cu) / fu
    slope_v  (H,) float64 (v - cv) / fv
    R        (3, 3) float64, rectified camera 0 -> LiDAR
    origin   (3,) float64, the colour camera in the LiDAR frame, metres
    """

    slope_u: NDArray[np.float64]
    slope_v: NDArray[np.float64]
    R: NDArray[np.float64]
    origin: NDArray[np.float64]

    @classmethod
    def of(cls, calibration: Calibration, image_size: tuple[int, int]) -> PixelRays:
        """The rays of an (H, W) image."""
        height, width = image_size
        P2, T = calibration.P2, calibration.T_velo_cam
        slope_u, slope_v = (np.arange(width) - P2[0, 2]) / P2[0, 0], (np.arange(height) - P2[1, 2]) / P2[1, 1]
        x, y = -P2[0, 3] / P2[0, 0], -P2[1, 3] / P2[1, 1]
        return cls(slope_u, slope_v, np.ascontiguousarray(T[:3, :3]), T[:3, 0] * x + T[:3, 1] * y + T[:3, 3])

    def reach(self, depth: NDArray[np.float32]) -> float:
        """Metres that no point of the map is farther from the LiDAR than."""
        longest = np.sqrt(1 + (self.slope_u**2).max(initial=0) + (self.slope_v**2).max(initial=0))
        return float(np.abs(self.origin).max() + np.linalg.norm(self.R) * longest * depth.max(initial=0))

    def project_rows(self, depth: NDArray[np.float32], top: int, block: NDArray[np.float32]) -> int:
        """Write the points of whole image rows from `top` on into (3, rows * W) `block`; how many it took."""
        return int(_project_rows(depth, top, self.slope_u, self.slope_v, self.R, self.origin, block))

    def project_pixels(self, depth: NDArray[np.float32], pixels: NDArray[np.int32]) -> NDArray[np.float32]:
        """(N,) pixels row * W + column -> (N, 3) float32 points, LiDAR frame."""
        points = np.empty((len(pixels), 3), np.float32)
        _project_pixels(depth, pixels, self.slope_u, self.slope_v, self.R, self.origin, points)
        return points


def back_project(depth: NDArray[np.float32], calibration: Calibration, keep: NDArray[np.bool_]) -> DenseCloud:
    """(H, W) depth in metres -> the points of the pixels that `keep` marks and that have a value, in row order.

    Raises DataError for a map of another shape than `keep` and for NaN, infinite or negative depth.
    """
    depth, kept = usable_pixels(depth, keep)
    pixels = np.flatnonzero(kept).astype(np.int32)
    return DenseCloud(PixelRays.of(calibration, depth.shape).project_pixels(depth, pixels), pixels)


def usable_pixels(depth: NDArray[np.float32], keep: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The depth map, contiguous, and the pixels to take: marked and with a value. Raises as `back_project`."""
    if depth.ndim != 2 or depth.shape != keep.shape:
        raise DataError("back-projection", f"an (H, W) depth map like the {keep.shape} mask", f"shape {depth.shape}")
    depth = np.ascontiguousarray(depth, dtype=np.float32)
    kept = np.empty(depth.shape, np.bool_)
    if _usable(depth.reshape(-1), np.ascontiguousarray(keep, np.bool_).reshape(-1), kept.reshape(-1)):
        raise DataError("back-projection", "finite depth >= 0 m, 0 = no value", "NaN, infinite or negative depth")
    return depth, kept


@njit(cache=True, nogil=True)
def _usable(depth, keep, kept):  # type: ignore[no-untyped-def]
    """Fill `kept`; returns how many depth values are none."""
    wrong = 0
    for i in range(depth.size):
        kept[i] = keep[i] & (depth[i] > 0)
        wrong += 1 - np.int64((depth[i] >= 0) & (depth[i] < np.inf))
    return wrong


@njit(cache=True, nogil=True)
def _project_rows(depth, top, slope_u, slope_v, R, origin, block):  # type: ignore[no-untyped-def]
    height, width = depth.shape
    rows = min(block.shape[1] // width, height - top)
    for row in range(rows):
        for axis in range(3):
            across, along = R[axis, 0], R[axis, 1] * slope_v[top + row] + R[axis, 2]
            z, out, start = depth[top + row], block[axis, row * width : (row + 1) * width], origin[axis]
            for column in range(width):
                out[column] = z[column] * (across * slope_u[column] + along) + start
    return rows


@njit(cache=True, nogil=True)
def _project_pixels(depth, pixels, slope_u, slope_v, R, origin, points):  # type: ignore[no-untyped-def]
    width = depth.shape[1]
    per_pixel = 1.0 / width
    flat = depth.reshape(-1)
    for i in range(pixels.size):
        # A product instead of a division; half a pixel keeps it clear of the rows' ends.
        row = np.int64((pixels[i] + 0.5) * per_pixel)
        z, u, v = np.float64(flat[pixels[i]]), slope_u[pixels[i] - row * width], slope_v[row]
        points[i, 0] = z * (R[0, 0] * u + (R[0, 1] * v + R[0, 2])) + origin[0]
        points[i, 1] = z * (R[1, 0] * u + (R[1, 1] * v + R[1, 2])) + origin[1]
        points[i, 2] = z * (R[2, 0] * u + (R[2, 1] * v + R[2, 2])) + origin[2]
