"""The three kinds of depth noise of thesis 5.3.2, made exact: every completed pixel gets one label.

With true depth D, estimate E, the (2 w + 1)^2 window of true depths around the pixel and the tolerance
tol(D) = base + slope D:

  unknown      E or D is missing
  clean        |E - D| <= tol(D)
  noise-inbet  the window spans at least `gap`, E lies strictly between its nearest and farthest true depth, and E is
               not within tolerance of any true depth in it: a floating point between two surfaces
  noise-fg     else, on an object pixel or within tolerance of the true depth of an object pixel in the window: the
               object is smeared, or has grown over its surroundings
  noise-bg     else: a wrong point of the background
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from auglidar_base.errors import SettingsError

UNKNOWN, CLEAN, NOISE_FG, NOISE_INBET, NOISE_BG = 0, 1, 2, 3, 4
LABELS = ("unknown", "clean", "noise-fg", "noise-inbet", "noise-bg")
# RGB for reports; readable for colour-blind readers (Okabe and Ito 2008).
COLOURS = ((90, 90, 90), (86, 180, 233), (230, 159, 0), (213, 94, 0), (204, 121, 167))


@dataclass(frozen=True)
class Taxonomy:
    """Thresholds.

    base, slope  tolerance base + slope * depth in metres; twice the misalignment of Eq. 5.2 with a = 0.01
    window       w in pixels: how far a discontinuity reaches
    gap          metres between surfaces from which a window counts as a discontinuity
    """

    base: float = 0.1
    slope: float = 0.02
    window: int = 5
    gap: float = 1.0

    def __post_init__(self) -> None:
        if min(self.base, self.slope, self.gap) < 0 or self.window < 1:
            raise SettingsError(f"taxonomy: expected thresholds >= 0 and a window >= 1 pixel, got {self}")


def label_noise(
    estimate: NDArray[np.float32], truth: NDArray[np.float32], objects: NDArray[np.bool_], taxonomy: Taxonomy
) -> NDArray[np.uint8]:
    """(H, W) labels, see the top of this file.

    estimate, truth  (H, W) float32 depth in metres, 0 = no value
    objects          (H, W) mask of pixels that truly show a relevant object

    Raises ValueError when shapes differ or values are NaN.
    """
    if not estimate.shape == truth.shape == objects.shape or estimate.ndim != 2:
        raise ValueError(f"taxonomy: shapes differ: {estimate.shape}, {truth.shape}, {objects.shape}")
    if not (np.isfinite(estimate).all() and np.isfinite(truth).all()):
        raise ValueError("taxonomy: NaN or infinite depth; use 0 for 'no value'")
    labels = np.zeros(estimate.shape, np.uint8)
    _label(
        np.ascontiguousarray(estimate, np.float32),
        np.ascontiguousarray(truth, np.float32),
        np.ascontiguousarray(objects, np.bool_),
        (taxonomy.base, taxonomy.slope, taxonomy.gap),
        taxonomy.window,
        labels,
    )
    return labels


@njit(cache=True, nogil=True)
def _label(estimate, truth, objects, limits, window, labels):  # type: ignore[no-untyped-def]
    base, slope, gap = limits
    height, width = estimate.shape
    for v in range(height):
        for u in range(width):
            e, d = np.float64(estimate[v, u]), np.float64(truth[v, u])
            if not (e > 0 and d > 0):
                continue
            if abs(e - d) <= base + slope * d:
                labels[v, u] = CLEAN
                continue
            near, far, on_surface, on_object = d, d, False, objects[v, u]
            for row in range(max(0, v - window), min(height, v + window + 1)):
                for column in range(max(0, u - window), min(width, u + window + 1)):
                    other = np.float64(truth[row, column])
                    if other > 0:
                        near, far = min(near, other), max(far, other)
                        if abs(e - other) <= base + slope * other:
                            on_surface = True
                            on_object = on_object or objects[row, column]
            if far - near >= gap and near < e < far and not on_surface:
                labels[v, u] = NOISE_INBET
            elif on_object:
                labels[v, u] = NOISE_FG
            else:
                labels[v, u] = NOISE_BG
