"""Rows (rings) of a rotating LiDAR: finding them in a file, and keeping every n-th.

KITTI's scans list ring after ring from the top, each counter-clockwise from the forward direction. A new ring starts
where the azimuth atan2(y, x) passes from negative to positive in front of the sensor; keeping rings r with
r mod step = 0 makes 32, 16 and 8-row scans from 64 rows (thesis section 4; the folder names `2x0`, `4x0`, `8x0`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def split_rings(points: NDArray[np.floating]) -> NDArray[np.int64]:
    """(N,) ring number of each of (N, 3+) LiDAR points in file order, 0 = top.

    Runs shorter than a tenth of the median ring (a few points that jitter over the forward direction) belong to the
    ring before them. Raises ValueError when the points are not (N, 3 or more).
    """
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points: expected (N, 3 or more) x y z ..., got shape {points.shape}")
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    x, y = np.asarray(points[:, 0], dtype=np.float64), np.asarray(points[:, 1], dtype=np.float64)
    forward = x > 0
    starts = 1 + np.flatnonzero((y[:-1] < 0) & (y[1:] >= 0) & forward[:-1] & forward[1:])
    bounds = np.concatenate([[0], starts, [len(points)]])
    lengths = np.diff(bounds)
    whole = lengths >= 0.1 * np.median(lengths)
    whole[0] = True
    kept = bounds[:-1][whole]
    ring = np.zeros(len(points), dtype=np.int64)
    ring[kept[1:]] = 1
    return np.cumsum(ring)


def subsample_rows(points: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """The points of rings 0, step, 2 step, ... of a scan in file order: step 2, 4, 8 make 32, 16, 8 rows of 64.

    Raises ValueError when step is below 1.
    """
    if step < 1:
        raise ValueError(f"step: expected 1 or more, got {step}")
    return points[split_rings(points) % step == 0]
