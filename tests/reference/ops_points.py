"""The point operations as plain loops, float32, one cloud at a time: what the kernels must reproduce exactly."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]


def squared_distances(cloud: Float, place: Float) -> Float:
    """(N,) from every point of cloud (N, 3) to place (3,)."""
    dx, dy, dz = (cloud - place).T
    return (dx * dx + dy * dy) + dz * dz


def furthest_point_sample(cloud: Float, npoint: int) -> list[int]:
    remaining = np.full(len(cloud), 1e10, np.float32)
    samples = [0]
    while len(samples) < npoint:
        remaining = np.minimum(remaining, squared_distances(cloud, cloud[samples[-1]]))
        samples.append(int(np.argmax(remaining)))  # the first of equal maxima
    return samples


def ball_query(cloud: Float, centres: Float, radius: float, nsample: int) -> list[list[int]]:
    radius2 = np.float32(radius) * np.float32(radius)
    result = []
    for centre in centres:
        hits: list[int] = []
        for index, distance in enumerate(squared_distances(cloud, centre)):
            if distance < radius2 and len(hits) < nsample:
                hits.append(index)
        filler = hits[0] if hits else 0
        result.append(hits + [filler] * (nsample - len(hits)))
    return result


def three_nn(unknown: Float, known: Float) -> tuple[list[list[float]], list[list[int]]]:
    distances, indices = [], []
    for place in unknown:
        ranked = sorted((float(d), i) for i, d in enumerate(squared_distances(known, place)))[:3]
        ranked += [(math.inf, 0)] * (3 - len(ranked))
        distances.append([float(np.sqrt(np.float32(d))) for d, _ in ranked])
        indices.append([i for _, i in ranked])
    return distances, indices


def three_interpolate(
    features: NDArray[np.float64], index: NDArray[np.int64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """features (C, M), index and weight (N, 3) -> (C, N)."""
    result = np.zeros((features.shape[0], len(index)))
    for channel in range(features.shape[0]):
        for n in range(len(index)):
            for k in range(3):
                result[channel, n] += weight[n, k] * features[channel, index[n, k]]
    return result


def is_inside(place: Float, box: Float, near: float) -> bool:
    """One point and one box x y z h w l ry, float32 throughout."""
    x, y, z, h, w, l, ry = (np.float32(value) for value in box)
    dx, dy, dz = place[0] - x, place[1] - (y - h / np.float32(2)), place[2] - z
    if abs(dx) > near or abs(dz) > near or abs(dy) > h / 2:
        return False
    along = dx * np.cos(ry) - dz * np.sin(ry)
    across = dx * np.sin(ry) + dz * np.cos(ry)
    return bool(abs(along) <= l / 2 and abs(across) <= w / 2)


def roi_pool(cloud: Float, features: Float, rois: Float, extra_width: float, nsample: int) -> tuple[Float, list[bool]]:
    """One cloud (N, 3), features (N, C), rois (M, 7) -> pooled (M, nsample, 3 + C), empty flags."""
    pooled = np.zeros((len(rois), nsample, 3 + features.shape[1]), np.float32)
    empty = []
    for m, roi in enumerate(rois):
        grown = roi.astype(np.float32).copy()
        grown[3:6] += np.float32(2 * extra_width)
        grown[1] += np.float32(extra_width)
        hits = [i for i in range(len(cloud)) if is_inside(cloud[i], grown, near=10.0)][:nsample]
        empty.append(not hits)
        for slot in range(nsample):
            if hits:
                point = hits[slot % len(hits)]
                pooled[m, slot] = np.concatenate([cloud[point], features[point]])
    return pooled, empty
