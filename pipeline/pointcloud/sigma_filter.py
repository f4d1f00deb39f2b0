"""The sigma filter: drop the pixels where the twin-surface model mixes two surfaces (thesis 5.3.4.1, Fig. 5.6a)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from auglidar_base.errors import SettingsError
from completion.types import CompletedDepth


@dataclass(frozen=True)
class SigmaBand:
    """The rectangle of Fig. 5.6a: dropped is low < sigma < high with background - foreground >= gap.

    low, high  weights of the foreground in [0, 1], exclusive
    gap        metres, inclusive
    """

    low: float = 0.2
    high: float = 0.8
    gap: float = 3.0

    def __post_init__(self) -> None:
        if not 0 <= self.low <= self.high <= 1:
            raise SettingsError(f"sigma filter: expected 0 <= low <= high <= 1, got {self.low:g} and {self.high:g}")
        if not self.gap >= 0:
            raise SettingsError(f"sigma filter: expected a gap >= 0 m, got {self.gap:g}")


def sigma_filter(completed: CompletedDepth, band: SigmaBand) -> NDArray[np.bool_]:
    """(H, W) mask of the pixels to keep: those with a depth value outside the band.

    Comparisons are made in float32, as NumPy makes them between a float32 map and a Python number.

    Raises ValueError for a completion with one surface; `pseudo_sigma` gives such a depth map two.
    """
    if completed.sigma is None or completed.foreground is None or completed.background is None:
        raise ValueError(
            "sigma filter: this completed depth has one surface and no sigma; "
            "use pseudo_sigma to estimate them from the depth map, or settings without the sigma filter"
        )
    keep = np.empty(completed.size, np.bool_)
    limits = np.array([band.low, band.high, band.gap], dtype=np.float32)
    _outside_band(
        completed.depth.reshape(-1),
        completed.foreground.reshape(-1),
        completed.background.reshape(-1),
        completed.sigma.reshape(-1),
        limits,
        keep.reshape(-1),
    )
    return keep


@njit(cache=True, nogil=True)
def _outside_band(depth, foreground, background, sigma, limits, keep):  # type: ignore[no-untyped-def]
    low, high, gap = limits[0], limits[1], limits[2]
    for i in range(depth.size):
        mixed = (sigma[i] > low) & (sigma[i] < high) & (background[i] - foreground[i] >= gap)
        keep[i] = (depth[i] > 0) & (not mixed)
