"""Which LiDAR returns does the camera really see?

LiDAR and camera stand apart, so background returns show through foreground objects in the projection. A window test on
the projected points cannot tell them apart (rings are 4-6 pixels apart, leaks reach 15 pixels). Here a surface is built
in the LiDAR's own order, where neighbours are known, sampled densely and z-buffered in the camera; a return well behind
it is occluded.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from pipeline.geometry.calibration import Calibration
from pipeline.geometry.in_view import MIN_DEPTH, pixel_of, pixels_and_depth, value_at

Array = NDArray[np.float64]

# Neighbours in one ring and across two adjacent rings, radians; the sensor's own steps are 0.17 degrees and below.
RING_STEP = np.deg2rad(0.45)
CROSS_STEP = np.deg2rad(0.22)
# Up to so many rings without a return between two returns of one surface are bridged (glass), nearer than this range.
BRIDGE_RINGS, BRIDGE_RANGE = 15, 30.0
SAMPLES_ACROSS, SAMPLES_ALONG = 8, 4
# Half the horizontal field that is looked at; KITTI's colour camera sees +-41 degrees.
HALF_FIELD = np.deg2rad(55.0)


def same_surface(range_a: Array, range_b: Array) -> NDArray[np.bool_]:
    """True where two ranges (metres) differ by less than 0.3 m + 3 %."""
    return np.abs(range_a - range_b) < 0.3 + 0.03 * np.minimum(range_a, range_b)


def surface_depth(
    points: NDArray[np.floating], ring: NDArray[np.integer], calibration: Calibration, image_size: tuple[int, int]
) -> Array:
    """Z-buffered depth (H, W) in metres of the surface through the returns; infinity where there is none.

    points  (N, 3+) LiDAR frame, metres, in file order
    ring    (N,) ring number of each point, 0 = top
    """
    xyz = np.asarray(points[:, :3], dtype=np.float64)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    keep = np.abs(azimuth) < HALF_FIELD
    xyz, azimuth, ring = xyz[keep], azimuth[keep], np.asarray(ring)[keep]
    order = np.lexsort((azimuth, ring))
    xyz, azimuth, ring = xyz[order], azimuth[order], ring[order]
    cam = calibration.velo_to_cam(xyz)
    ranges = np.linalg.norm(xyz, axis=1)

    along = _neighbours_in_ring(azimuth, ring, ranges)
    below = _neighbours_below(azimuth, ring, ranges)
    buffer = np.full(image_size, np.inf)
    first = np.flatnonzero(along)
    _splat_links(buffer, cam[first], cam[first + 1], calibration.P2, SAMPLES_ACROSS)
    upper = np.flatnonzero(below >= 0)
    _splat_links(buffer, cam[upper], cam[below[upper]], calibration.P2, SAMPLES_ACROSS)
    # A cell is filled when its four sides are links: p0-p1 in one ring, q0-q1 in the next.
    cell = first[(below[first] >= 0) & (below[first + 1] >= 0)]
    q0, q1 = below[cell], below[cell + 1]
    closed = (q0 == q1) | ((q1 == q0 + 1) & along[q0])
    cell, q0, q1 = cell[closed], q0[closed], q1[closed]
    for step in np.linspace(0, 1, SAMPLES_ALONG):
        top = (1 - step) * cam[cell] + step * cam[cell + 1]
        bottom = (1 - step) * cam[q0] + step * cam[q1]
        _splat_links(buffer, top, bottom, calibration.P2, SAMPLES_ACROSS)
    bridge_a, bridge_b = _bridges(azimuth, ring, ranges)
    _splat_links(buffer, cam[bridge_a], cam[bridge_b], calibration.P2, 4 * SAMPLES_ACROSS)
    return buffer


def visible_points(
    points: NDArray[np.floating], ring: NDArray[np.integer], calibration: Calibration, image_size: tuple[int, int]
) -> NDArray[np.bool_]:
    """(N,) True where a return is inside the image and not hidden behind the surface of `surface_depth`.

    Hidden = more than max(1 m, 5 %) behind the nearest surface within one pixel.
    """
    surface = minimum_filter(surface_depth(points, ring, calibration, image_size), size=3, mode="nearest")
    pixels, depth = pixels_and_depth(points, calibration, image_size)
    nearest = value_at(pixels, surface)
    return (pixels >= 0) & (depth <= nearest + np.maximum(1.0, 0.05 * nearest))


def _neighbours_in_ring(azimuth: Array, ring: NDArray[np.integer], ranges: Array) -> NDArray[np.bool_]:
    """(N,) True where point i and i + 1 are linked within their ring."""
    linked = np.zeros(len(azimuth), dtype=bool)
    linked[:-1] = (ring[1:] == ring[:-1]) & (np.diff(azimuth) <= RING_STEP) & same_surface(ranges[:-1], ranges[1:])
    return linked


@njit(cache=True)
def _neighbours_below(azimuth, ring, ranges):  # type: ignore[no-untyped-def]
    """(N,) index of the linked point of the next ring, or -1; the points come sorted by ring and azimuth."""
    n = len(azimuth)
    below = np.full(n, -1, dtype=np.int64)
    rings = int(ring.max()) + 1 if n else 0
    start = np.searchsorted(ring, np.arange(rings + 1))
    for r in range(rings - 1):
        k, end = start[r + 1], start[r + 2]
        if k == end:
            continue
        for i in range(start[r], start[r + 1]):
            while k + 1 < end and abs(azimuth[k + 1] - azimuth[i]) <= abs(azimuth[k] - azimuth[i]):
                k += 1
            near = min(ranges[i], ranges[k])
            if abs(azimuth[k] - azimuth[i]) <= CROSS_STEP and abs(ranges[i] - ranges[k]) < 0.3 + 0.03 * near:
                below[i] = k
    return below


def _bridges(azimuth: Array, ring: NDArray[np.integer], ranges: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of returns of one surface with 1 to BRIDGE_RINGS empty rings between them in their azimuth column."""
    column = ((azimuth + HALF_FIELD) / CROSS_STEP).astype(np.int64)
    rings = int(ring.max()) + 1 if len(ring) else 0
    grid = np.full((rings, column.max(initial=0) + 1), -1, dtype=np.int64)
    grid[ring, column] = np.arange(len(ring))
    rows, columns = np.nonzero(grid.T >= 0)[::-1]
    same_column = columns[1:] == columns[:-1]
    gap = rows[1:] - rows[:-1]
    a, b = grid[rows[:-1], columns[:-1]], grid[rows[1:], columns[1:]]
    bridged = same_column & (gap > 1) & (gap <= BRIDGE_RINGS + 1) & (ranges[a] < BRIDGE_RANGE)
    bridged &= same_surface(ranges[a], ranges[b])
    return a[bridged], b[bridged]


def _splat_links(buffer: Array, start: Array, end: Array, P2: Array, samples: int) -> None:
    """Writes `samples` points on each segment start-end (M, 3, camera frame) into the z-buffer."""
    _splat(buffer, np.ascontiguousarray(start), np.ascontiguousarray(end), np.ascontiguousarray(P2), samples)


@njit(cache=True)
def _splat(buffer, start, end, P2, samples):  # type: ignore[no-untyped-def]
    height, width = buffer.shape
    flat = buffer.reshape(-1)
    for i in range(len(start)):
        for s in range(samples):
            t = s / (samples - 1)
            x = (1 - t) * start[i, 0] + t * end[i, 0]
            y = (1 - t) * start[i, 1] + t * end[i, 1]
            z = (1 - t) * start[i, 2] + t * end[i, 2]
            pixel = pixel_of(P2, x, y, z, height, width) if z > MIN_DEPTH else -1
            if pixel >= 0 and z < flat[pixel]:
                flat[pixel] = z
