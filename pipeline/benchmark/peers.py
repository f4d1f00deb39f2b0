"""Completion without learning, as peers of the benchmark: nearest sample and linear interpolation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import distance_transform_edt

Map = NDArray[np.float32]


def nearest(sparse: Map) -> Map:
    """Every pixel takes the nearest sample; (H, W) metres."""
    if not (sparse > 0).any():
        return np.zeros_like(sparse)
    index = distance_transform_edt(sparse == 0, return_distances=False, return_indices=True)
    filled: Map = sparse[tuple(index)]
    return filled


def linear_inverse(sparse: Map) -> Map:
    """Delaunay interpolation, linear in inverse depth; 0 outside the convex hull of the samples."""
    row, column = np.nonzero(sparse)
    if len(row) < 3:
        return np.zeros_like(sparse)
    inverse = LinearNDInterpolator(np.column_stack([column, row]), 1 / sparse[row, column])
    grid_row, grid_column = np.mgrid[: sparse.shape[0], : sparse.shape[1]]
    with np.errstate(divide="ignore"):
        dense = 1 / inverse(grid_column, grid_row)
    return np.nan_to_num(dense, nan=0, posinf=0).astype(np.float32)


PEERS: dict[str, Callable[[Map], Map]] = {"nearest": nearest, "linear_inverse": linear_inverse}
