"""Back-projection, the exact inverse of the projection, for maps, lists of pixels and rays (thesis section 5.3.1).

P2 = K [I | -c]: camera 2 stands at c = -inv(K) P2[:, 3] in rectified camera 0 and sees pixel (u, v) along
inv(K) (u, v, 1), here scaled to z = 1. Depth is z of camera 0, so the point is

    c + (depth - c_z) * direction

and with T_velo_cam = [R | t] the same in the LiDAR frame. c_z is -P2[2, 3] / P2[2, 2], -2.7 mm in KITTI; the usual
formula x = (u - cu) / fu * z - p0 / fu leaves it out, which moves points by up to 9 mm. In float64, rounded to
float32 once at the end.

The camera matrix may have skew (P2[0, 1]) and any scale P2[2, 2]; P2[2, :2] must be 0, so that the image plane is
parallel to that of camera 0, as it is in every rectified pair.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeline.base.errors import DataError
from pipeline.geometry.calibration import Calibration
from pipeline.geometry.clouds import DenseCloud

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PixelRays:
    """What back-projection needs of a calibration.

    directions  (3, 3) float64, directions @ (u, v, 1) is the ray of a pixel, LiDAR frame, z = 1 m in the camera
    origin      (3,) float64, camera 2 in the LiDAR frame, metres
    behind      metres that camera 2 stands behind camera 0: depth + behind is counted from `origin`
    """

    directions: Array
    origin: Array
    behind: float

    @classmethod
    def of(cls, calibration: Calibration) -> PixelRays:
        """The rays of a calibration. Raises DataError when the planes of camera 0 and the image are not parallel."""
        P2, T = calibration.P2, calibration.T_velo_cam
        if P2[2, :2].any() or P2[2, 2] <= 0:
            found = " ".join(f"{value:g}" for value in P2[2])
            raise DataError("calibration P2", "a third row 0 0 s t with s > 0 (a rectified camera)", found)
        inverse = np.linalg.inv(calibration.K)
        centre = -inverse @ P2[:, 3]
        directions = T[:3, :3] @ (inverse * P2[2, 2])
        return cls(np.ascontiguousarray(directions), T[:3, :3] @ centre + T[:3, 3], float(-centre[2]))

    def through(self, u: NDArray[Any], v: NDArray[Any]) -> Array:
        """(..., 3) rays through columns u and rows v, which need not be whole; their length is range over depth."""
        pixels = np.stack([np.asarray(u, np.float64), np.asarray(v, np.float64), np.ones(np.shape(u))], axis=-1)
        return pixels @ self.directions.T

    def reach(self, depth: NDArray[np.float32]) -> float:
        """Metres that no point of the map is farther from the LiDAR than."""
        bottom, right = depth.shape[0] - 1, depth.shape[1] - 1
        corners = self.through(np.array([0, right, 0, right]), np.array([0, 0, bottom, bottom]))
        longest = np.linalg.norm(corners, axis=1).max()
        return float(np.abs(self.origin).max() + longest * (depth.max(initial=0) + abs(self.behind)))

    def project_rows(self, depth: NDArray[np.float32], top: int, block: NDArray[np.float32]) -> int:
        """Write the points of whole image rows from `top` on into (3, rows * W) `block`; how many it took."""
        return int(_project_rows(depth, top, self.directions, self.origin, self.behind, block))

    def project_pixels(self, depth: NDArray[np.float32], pixels: NDArray[np.int32]) -> NDArray[np.float32]:
        """(N,) pixels row * W + column -> (N, 3) float32 points, LiDAR frame."""
        points = np.empty((len(pixels), 3), np.float32)
        _project_pixels(depth, pixels, self.directions, self.origin, self.behind, points)
        return points


def pixels_to_velo(u: NDArray[Any], v: NDArray[Any], depth: NDArray[Any], calibration: Calibration) -> Array:
    """(N,) columns, rows (not necessarily whole) and depths in metres -> (N, 3) float64 points in the LiDAR frame.

    Raises DataError as `PixelRays.of`.
    """
    rays = PixelRays.of(calibration)
    return (np.asarray(depth, np.float64) + rays.behind)[:, None] * rays.through(u, v) + rays.origin


def depth_pixels(depth: NDArray[np.float32]) -> tuple[Array, Array, Array]:
    """(u, v, depth) of the pixels with a value, row by row."""
    v, u = np.nonzero(depth)
    return u.astype(np.float64), v.astype(np.float64), depth[v, u].astype(np.float64)


def back_project(depth: NDArray[np.float32], calibration: Calibration, keep: NDArray[np.bool_]) -> DenseCloud:
    """(H, W) depth in metres -> the points of the pixels that `keep` marks and that have a value, in row order.

    Raises DataError for a map of another shape than `keep`, for NaN, infinite or negative depth, and as `PixelRays.of`.
    """
    depth, kept = usable_pixels(depth, keep)
    pixels = np.flatnonzero(kept).astype(np.int32)
    return DenseCloud(PixelRays.of(calibration).project_pixels(depth, pixels), pixels)


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
def _project_rows(depth, top, directions, origin, behind, block):  # type: ignore[no-untyped-def]
    height, width = depth.shape
    rows = min(block.shape[1] // width, height - top)
    for row in range(rows):
        for axis in range(3):
            across, along = directions[axis, 0], directions[axis, 1] * (top + row) + directions[axis, 2]
            z, out, start = depth[top + row], block[axis, row * width : (row + 1) * width], origin[axis]
            for column in range(width):
                out[column] = (z[column] + behind) * (across * column + along) + start
    return rows


@njit(cache=True, nogil=True)
def _project_pixels(depth, pixels, directions, origin, behind, points):  # type: ignore[no-untyped-def]
    width = depth.shape[1]
    per_pixel = 1.0 / width
    flat = depth.reshape(-1)
    D = directions
    for i in range(pixels.size):
        # A product instead of a division; half a pixel keeps it clear of the rows' ends.
        row = np.int64((pixels[i] + 0.5) * per_pixel)
        z, u = flat[pixels[i]] + behind, pixels[i] - row * width
        points[i, 0] = z * (D[0, 0] * u + (D[0, 1] * row + D[0, 2])) + origin[0]
        points[i, 1] = z * (D[1, 0] * u + (D[1, 1] * row + D[1, 2])) + origin[1]
        points[i, 2] = z * (D[2, 0] * u + (D[2, 1] * row + D[2, 2])) + origin[2]
