"""Gathering by distance: completed points within a radius of anchor points (thesis 5.3.4.2 and 5.3.4.3).

Anchors are the raw LiDAR returns (augmented LiDAR) or the relevant object points (background context).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import floor

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipeline.pointcloud.cells import CELL_LIMIT, assign_cells, find, pack, refuse

# The radius in cells: just under half a cell, so that rounding can never push a neighbour into a third cell.
_REACH = 0.5 * (1 - 1e-6)


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
            raise ValueError(f"radius gathering: expected radii > 0 m and split >= 0 m, got {self}")


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
            _gather(points, group, anchors, radius, gathered)
    return gathered


def _gather(
    points: NDArray[np.float32],
    group: NDArray[np.bool_],
    anchors: NDArray[np.float32],
    radius: float,
    gathered: NDArray[np.bool_],
) -> None:
    """Mark the points of `group` within `radius` of an anchor; cells are twice the radius, so 8 are looked at."""
    cell_of_anchor = np.empty(len(anchors), np.int32)
    inverse_size = _REACH / radius
    cells, table, keys = assign_cells(anchors, inverse_size, cell_of_anchor)
    refuse(cells, "radius gathering", 1 / inverse_size)
    starts = np.zeros(cells + 1, np.int32)
    members = np.empty((len(anchors), 3), np.float32)
    _sort_by_cell(anchors, cell_of_anchor, starts, members)
    _mark_near(points, group, members, starts, table, keys, inverse_size, radius * radius, gathered)


@njit(cache=True, nogil=True)
def _sort_by_cell(anchors, cell_of_anchor, starts, members):  # type: ignore[no-untyped-def]
    """Counting sort: the anchors of cell c become members[starts[c] : starts[c + 1]]."""
    for cell in cell_of_anchor:
        starts[cell + 1] += 1
    for cell in range(starts.size - 1):
        starts[cell + 1] += starts[cell]
    fill = starts[:-1].copy()
    for i in range(cell_of_anchor.size):
        at = fill[cell_of_anchor[i]]
        fill[cell_of_anchor[i]] += 1
        for axis in range(3):
            members[at, axis] = anchors[i, axis]


@njit(cache=True, nogil=True)
def _cell_has_near(x, y, z, key, members, starts, table, keys, limit):  # type: ignore[no-untyped-def]
    """True when cell `key` holds an anchor with squared distance <= limit."""
    cell = find(key, table, keys)
    if cell < 0:
        return False
    for j in range(starts[cell], starts[cell + 1]):
        dx, dy, dz = x - members[j, 0], y - members[j, 1], z - members[j, 2]
        if dx * dx + dy * dy + dz * dz <= limit:
            return True
    return False


@njit(cache=True, nogil=True)
def _mark_near(points, group, members, starts, table, keys, inverse_size, limit, gathered):  # type: ignore[no-untyped-def]
    for i in range(points.shape[0]):
        if not group[i]:
            continue
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        fx, fy, fz = x * inverse_size, y * inverse_size, z * inverse_size
        if not max(abs(fx), abs(fy), abs(fz)) < CELL_LIMIT - 2:
            continue  # no anchor lies beyond the limit, so none is near
        ix, iy, iz = floor(fx), floor(fy), floor(fz)
        # The side of the cell on which a second cell comes within reach; the own cell is looked at first.
        sx, sy, sz = _side(fx - ix), _side(fy - iy), _side(fz - iz)
        for corner in range(8):
            cx, cy, cz = corner & 1, (corner >> 1) & 1, corner >> 2
            key = pack(ix + cx * sx, iy + cy * sy, iz + cz * sz)
            if _cell_has_near(x, y, z, key, members, starts, table, keys, limit):
                gathered[i] = True
                break


@njit(cache=True, nogil=True, inline="always")
def _side(fraction):  # type: ignore[no-untyped-def]
    return 1 if fraction >= 0.5 else -1
