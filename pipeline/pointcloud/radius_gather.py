"""Gathering by distance: completed points within a radius of anchor points (thesis 5.3.4.2 and 5.3.4.3).

Anchors are the raw LiDAR returns (augmented LiDAR) or the relevant object points (background context).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from auglidar_base.errors import SettingsError
from pipeline.pointcloud.cells import mark_near


@dataclass(frozen=True)
class Radii:
    """r1 up to distance d, r2 beyond (thesis 5.3.4.3, Table 5.6).

    near   r1 in metres, used for forward distance <= split
    far    r2 in metres, used for forward distance > split
    split  d in metres
    """

    near: float = 0.3
    far: float = 1.5
    split: float = 40.0

    def __post_init__(self) -> None:
        if not (0 < self.near < np.inf and 0 < self.far < np.inf and self.split >= 0):
            raise SettingsError(f"radius gathering: expected radii > 0 m and split >= 0 m, got {self}")


def radius_gather(
    points: NDArray[np.float32], forward: NDArray[np.float32], anchors: NDArray[np.float32], radii: Radii
) -> NDArray[np.bool_]:
    """(N,) mask of the points that have an anchor within r1 (forward <= split) or r2 (forward > split), inclusive.

    points   (N, 3) float32, metres
    forward  (N,) float32, the distance that decides between the radii: the depth of the completed point along the
             optical axis ("depth points that are within d m from the camera", thesis 5.3.4.3)
    anchors  (M, 3 or more) float32, metres, same frame as `points`

    Distances are float64: dx * dx + dy * dy + dz * dz <= r * r. Raises ValueError for NaN or infinite values.
    """
    if len(points) != len(forward):
        raise ValueError(f"radius gathering: {len(points)} points and {len(forward)} forward distances")
    if not (np.isfinite(points).all() and np.isfinite(forward).all()):
        raise ValueError("radius gathering: the points hold NaN or infinite values; drop them first")
    gathered = np.zeros(len(points), np.bool_)
    is_far = forward > np.float32(radii.split)
    for radius, group in ((radii.near, ~is_far), (radii.far, is_far)):
        if group.any() or not len(points):
            mark_near(points, group, anchors, radius, gathered)
    return gathered
