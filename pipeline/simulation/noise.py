"""Depth noise of thesis section 5.3.2 (Eq. 5.1-5.3, Table 5.8), for maps whose truth is known.

All functions take and give (H, W) float32 depth in metres along the optical axis, 0 = no value; pixels without a value
stay without, and a seed decides everything random.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import cv2
import numpy as np
from numpy.typing import NDArray

from auglidar_base.errors import SettingsError
from completion.types import CompletedDepth

Depth = NDArray[np.float32]


@dataclass(frozen=True)
class NoiseSettings:
    """How much of each noise; 0 leaves a kind out. They are applied in this order.

    dilate      pixels by which near surfaces grow over far ones
    blur        rho of Eq. 5.1 in pixels
    gap         metres of depth difference that make a discontinuity; blur and dilation act only there, 0 = everywhere
    slope       a of Eq. 5.2; with `base` the standard deviation nu = base + a * depth
    base        metres, 0.05 in Eq. 5.2
    drop        share of pixels that lose their value
    """

    dilate: int = 0
    blur: float = 0.0
    gap: float = 1.0
    slope: float = 0.0
    base: float = 0.0
    drop: float = 0.0

    def __post_init__(self) -> None:
        if min(self.dilate, self.blur, self.gap, self.slope, self.base) < 0 or not 0 <= self.drop <= 1:
            raise SettingsError(f"noise: expected values >= 0 and a drop-out in [0, 1], got {self}")


def add_noise(depth: Depth, settings: NoiseSettings, seed: int) -> Depth:
    """All kinds of `settings`, one after the other."""
    random = np.random.default_rng(seed)
    noisy = dilate_boundaries(depth, settings.dilate, settings.gap) if settings.dilate else _checked(depth)
    noisy = blur_depth(noisy, settings.blur, settings.gap) if settings.blur else noisy
    if settings.slope or settings.base:
        noisy = misalign(noisy, settings.slope, settings.base, random)
    return drop_out(noisy, settings.drop, random) if settings.drop else noisy


def gaussian_kernel(rho: float) -> NDArray[np.float64]:
    """Eq. 5.1 along one axis, cut at 3 rho and normalised to sum 1.

    The printed factor 1 / sqrt(2 pi rho^2) normalises one dimension; the 2D kernel is the product of two such, which
    leaves a constant depth unchanged.
    """
    if not rho > 0:
        raise ValueError(f"blur: expected a standard deviation rho > 0 pixels, got {rho:g}")
    reach = np.arange(-ceil(3 * rho), ceil(3 * rho) + 1)
    weights = np.exp(-(reach**2) / (2 * rho**2))
    return np.asarray(weights / weights.sum())


def blur_depth(depth: Depth, rho: float, gap: float = 0.0) -> Depth:
    """Mixed depth: the Gaussian mean of the valid pixels around each valid pixel (Eq. 5.1 and the one after it).

    Pixels without a value and outside the image have weight 0, so they do not pull depth towards 0. With `gap` > 0
    only pixels change whose kernel window spans at least `gap` metres ("along the depth discontinuities", Table 5.8).
    """
    depth = _checked(depth)
    kernel = gaussian_kernel(rho)
    valid = depth > 0
    sums = cv2.sepFilter2D(depth, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_CONSTANT)
    weights = cv2.sepFilter2D(valid.astype(np.float64), cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_CONSTANT)
    changed = valid & discontinuities(depth, len(kernel) // 2, gap)
    return np.where(changed, sums / np.where(changed, weights, 1), depth).astype(np.float32)


def discontinuities(depth: Depth, reach: int, gap: float) -> NDArray[np.bool_]:
    """(H, W) mask of pixels where valid depth within +-`reach` pixels spans at least `gap` metres."""
    nearest, farthest = _local_range(depth, reach)
    return np.asarray((farthest > 0) & (farthest - nearest >= gap))


def misalign(depth: Depth, slope: float, base: float, random: np.random.Generator) -> Depth:
    """Depth misalignment, Eq. 5.2 and 5.3: D + eta with eta ~ N(0, nu) and nu = base + slope * D.

    nu is read as the standard deviation, as the text around the equation calls it (not the variance that the notation
    N(0, nu) could mean). The pixel stays the same, so the point moves along its optical ray; eta is measured along the
    optical axis. A value that would reach 0 is kept at 1 cm.
    """
    depth = _checked(depth)
    if min(slope, base) < 0:
        raise ValueError(f"misalignment: expected slope and base >= 0, got {slope:g} and {base:g}")
    eta = random.standard_normal(depth.shape) * (base + slope * depth.astype(np.float64))
    return np.where(depth > 0, np.maximum(depth + eta, 0.01), 0).astype(np.float32)


def drop_out(depth: Depth, share: float, random: np.random.Generator) -> Depth:
    """Every pixel loses its value with probability `share`."""
    if not 0 <= share <= 1:
        raise ValueError(f"drop-out: expected a share in [0, 1], got {share:g}")
    return np.where(random.random(depth.shape) < share, 0, _checked(depth)).astype(np.float32)


def dilate_boundaries(depth: Depth, pixels: int, gap: float) -> Depth:
    """Near surfaces grow by `pixels` over surfaces at least `gap` metres behind them, as outlines in estimates do."""
    depth = _checked(depth)
    nearest, _ = _local_range(depth, pixels)
    return np.where((depth > 0) & (depth - nearest >= gap), nearest, depth).astype(np.float32)


def _local_range(depth: Depth, reach: int) -> tuple[Depth, Depth]:
    """Smallest and largest valid depth within +-`reach` pixels; infinity and 0 where there is none."""
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    infinite = np.where(depth > 0, depth, np.float32(np.inf))
    nearest = cv2.erode(infinite, window, borderType=cv2.BORDER_CONSTANT, borderValue=np.inf)
    farthest = cv2.dilate(depth, window, borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
    return np.asarray(nearest), np.asarray(farthest)


def _checked(depth: Depth) -> Depth:
    """The map as `CompletedDepth` accepts it (finite, not negative, two axes)."""
    return CompletedDepth(depth).depth
