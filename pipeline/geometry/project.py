"""Projection of a LiDAR cloud to a sparse depth map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.calibration import Calibration


def project_points(
    points: NDArray[np.floating], calibration: Calibration, image_size: tuple[int, int], min_depth: float = 0.5
) -> NDArray[np.float32]:
    """Z-buffered projection: (N, 3+) LiDAR points -> (H, W) float32 depth in metres, 0 = none.

    A point falls on the pixel nearest to its projection; the nearest point wins where several share one, so that far
    points never overwrite near ones (official `velodyne_raw` maps are made the same way, but ego-motion corrected).
    """
    height, width = image_size
    pixels, depth = calibration.cam_to_image(calibration.velo_to_cam(points))
    in_front = depth > min_depth
    pixels, depth = pixels[in_front], depth[in_front]
    column, row = np.rint(pixels).astype(np.int64).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    flat, depth = (row * width + column)[inside], depth[inside].astype(np.float32)
    nearest = np.full(height * width, np.inf, dtype=np.float32)
    np.minimum.at(nearest, flat, depth)
    nearest[np.isinf(nearest)] = 0
    return nearest.reshape(height, width)
