"""Projection of a LiDAR cloud to a sparse depth map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.calibration import Calibration
from pipeline.geometry.in_view import pixels_and_depth

# Points whose pixels and depths are in memory together: a cloud of 500 MB would take as much again.
_AT_ONCE = 1 << 20


def project_points(
    points: NDArray[np.floating], calibration: Calibration, image_size: tuple[int, int]
) -> NDArray[np.float32]:
    """Z-buffered projection: (N, 3+) LiDAR points -> (H, W) float32 depth in metres, 0 = none.

    Points fall where `in_view.lidar_pixels` says; the nearest point wins where several share a pixel, so that far
    points never overwrite near ones (official `velodyne_raw` maps are made the same way, but ego-motion corrected).
    """
    height, width = image_size
    nearest = np.full(height * width, np.inf, dtype=np.float32)
    for start in range(0, len(points), _AT_ONCE):
        pixels, depth = pixels_and_depth(points[start : start + _AT_ONCE], calibration, image_size)
        seen = pixels >= 0
        np.minimum.at(nearest, pixels[seen], depth[seen].astype(np.float32))
    nearest[np.isinf(nearest)] = 0
    return nearest.reshape(height, width)
