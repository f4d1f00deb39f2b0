"""Headings and sizes as Frustum PointNet codes them: a bin or cluster, and what is left over.

Source: Qi et al. 2018, "Frustum PointNets for 3D Object Detection from RGB-D Data", and its published code.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Order of the one-hot class vector.
CLASSES = ("Car", "Pedestrian", "Cyclist")
HEADING_BINS = 12
BIN = 2 * np.pi / HEADING_BINS

# Mean length, width, height in metres of KITTI's types; their order is the order of the size clusters.
MEAN_SIZES: dict[str, tuple[float, float, float]] = {
    "Car": (3.88311640418, 1.62856739989, 1.52563191462),
    "Van": (5.06763659, 1.9007158, 2.20532825),
    "Truck": (10.13586957, 2.58549199, 3.2520595),
    "Pedestrian": (0.84422524, 0.66068622, 1.76255119),
    "Person_sitting": (0.80057803, 0.5983815, 1.27450867),
    "Cyclist": (1.76282397, 0.59706367, 1.73698127),
    "Tram": (16.17150617, 2.53246914, 3.53079012),
    "Misc": (3.64300781, 1.54298177, 1.92320313),
}
CLUSTERS = tuple(MEAN_SIZES)
SIZE_TABLE: Array = np.array(list(MEAN_SIZES.values()))


def encode_heading(angle: Array) -> tuple[NDArray[np.int64], Array]:
    """(N,) radians -> bin 0 to 11, whose centre is bin * 30 degrees, and the rest in [-15, 15) degrees as radians."""
    shifted = (np.asarray(angle, dtype=np.float64) + BIN / 2) % (2 * np.pi)
    # The remainder of a tiny negative number rounds to the whole turn.
    bins = np.floor(shifted / BIN).astype(np.int64).clip(0, HEADING_BINS - 1)
    return bins, shifted - bins * BIN - BIN / 2


def decode_heading(bins: NDArray[np.int64], residual: Array) -> Array:
    """Inverse of `encode_heading`, (N,) radians; a turn is taken off above pi."""
    angle = np.asarray(bins) * BIN + np.asarray(residual, dtype=np.float64)
    return np.where(angle > np.pi, angle - 2 * np.pi, angle)


def encode_size(size: Array, clusters: NDArray[np.int64]) -> Array:
    """(N, 3) l w h in metres and clusters (N,) -> (N, 3) metres beyond the mean size."""
    return np.asarray(np.asarray(size, dtype=np.float64) - SIZE_TABLE[clusters])


def decode_size(clusters: NDArray[np.int64], residual: Array) -> Array:
    """Inverse of `encode_size`: (N, 3) l w h in metres."""
    return np.asarray(SIZE_TABLE[clusters] + residual)
