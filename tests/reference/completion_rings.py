"""Rings by trying every sample: what `completion.models.rings` says about one pixel."""

from __future__ import annotations

import numpy as np

SIDE_COST = 2.5


def nearest(sparse: np.ndarray, row: int, column: int, upwards: bool) -> tuple[float, set[float]]:
    """Least cost of the samples in the pixel's row or above it (below it), and the depths found at that cost.

    A path climbs one row at a time and may change the column by one as it does; every column aside costs 2.5, a climb
    straight on costs 1. Without any sample: infinite, none.
    """
    costs: dict[float, set[float]] = {}
    for r, c in zip(*np.nonzero(sparse)):
        climbs, aside = (row - r if upwards else r - row), abs(int(c) - column)
        if climbs >= 0:
            cost = SIDE_COST * aside + max(0, int(climbs) - aside)
            costs.setdefault(cost, set()).add(float(sparse[r, c]))
    return (min(costs), costs[min(costs)]) if costs else (np.inf, set())
