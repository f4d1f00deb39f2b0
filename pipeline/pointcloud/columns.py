"""Extra columns of an augmented cloud: what a detector may use to weigh a point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from completion.types import CompletedDepth
from pipeline.geometry.clouds import DenseCloud
from pipeline.geometry.in_view import value_at


def expected_error(completed: CompletedDepth) -> NDArray[np.float32]:
    """(H, W) expected absolute depth error in metres when the twin surfaces are the two possible depths.

    The true depth is d1 with weight s and d2 with 1 - s, and the estimate is s d1 + (1 - s) d2 (thesis Eq. 4.5), so
    the expected |error| is s (1 - s) |d2 - d1| + (1 - s) s |d2 - d1| = 2 s (1 - s) |d2 - d1|.
    """
    if completed.sigma is None or completed.foreground is None or completed.background is None:
        raise ValueError("expected error: this completed depth has one surface and no sigma; see pseudo_sigma")
    sigma = completed.sigma
    error = 2 * sigma * (1 - sigma) * np.abs(completed.background - completed.foreground)
    return np.asarray(error, dtype=np.float32)


def completed_columns(
    names: tuple[str, ...],
    dense: DenseCloud,
    completed: CompletedDepth,
    score: NDArray[np.float32] | None,
    lidar: NDArray[np.float32],
) -> NDArray[np.float32]:
    """(N, C) float32 columns of completed points; `names` as in `presets.COLUMNS`."""
    table = np.zeros((len(dense), len(names)), np.float32)
    for column, name in enumerate(names):
        if name == "semantic" and score is not None:
            table[:, column] = dense.look_up(score)
        elif name == "sigma" and completed.sigma is not None:
            table[:, column] = dense.look_up(completed.sigma)
        elif name == "gap" and completed.background is not None and completed.foreground is not None:
            table[:, column] = dense.look_up(completed.background) - dense.look_up(completed.foreground)
        elif name == "expected_error":
            table[:, column] = dense.look_up(expected_error(completed))
        elif name == "nearest_return":
            table[:, column] = nearest_distance(dense.points, lidar)
        else:
            raise ValueError(f"column {name!r} cannot be computed: the frame lacks what it is made from")
    return table


def measured_columns(
    names: tuple[str, ...], pixels: NDArray[np.int64], score: NDArray[np.float32] | None
) -> NDArray[np.float32]:
    """(N, C) float32 columns of raw returns: one sure surface (sigma 1), no gap, no expected error, distance 0."""
    table = np.zeros((len(pixels), len(names)), np.float32)
    for column, name in enumerate(names):
        if name == "semantic" and score is not None:
            table[:, column] = value_at(pixels, score)
        elif name == "sigma":
            table[:, column] = 1
    return table


def nearest_distance(points: NDArray[np.float32], anchors: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N,) float32 metres from each point to its nearest anchor, infinity without anchors."""
    if not len(anchors) or not len(points):
        return np.full(len(points), np.inf, np.float32)
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(anchors[:, :3]).query(points)
    return np.asarray(distance, dtype=np.float32)
