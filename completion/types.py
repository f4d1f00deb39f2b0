"""The two values that travel through depth completion: what goes in and what comes out.

Both are checked when they are built, so that every later function can rely on shapes, dtypes and units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatMap = NDArray[np.float32]


def _depth_map(name: str, value: Any, shape: tuple[int, int] | None = None) -> FloatMap:
    """`value` as a finite, non-negative float32 (H, W) map, or a ValueError that names it."""
    array = np.ascontiguousarray(value, dtype=np.float32)
    if array.ndim != 2:
        raise ValueError(f"{name}: expected an (H, W) map, got shape {array.shape}")
    if shape is not None and array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape} like the other maps of this frame, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: {int((~np.isfinite(array)).sum())} values are NaN or infinite; use 0 for 'no value'")
    if array.size and float(array.min()) < 0:
        raise ValueError(f"{name}: smallest value is {float(array.min()):g} m; depth is metres, 0 = no value")
    return array


@dataclass(frozen=True)
class DepthFrame:
    """Input of completion.

    image   (H, W, 3) uint8, RGB
    sparse  (H, W) float32, metres along the optical axis, 0 = no value; all zero is the monocular case
    target  (H, W) float32 like `sparse`, the ground truth, or None
    K       (3, 3) float64 camera matrix in pixels, or None
    """

    image: NDArray[np.uint8]
    sparse: FloatMap
    target: FloatMap | None = None
    K: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        image = np.ascontiguousarray(self.image)
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise ValueError(f"image: expected (H, W, 3) uint8 RGB, got shape {image.shape} dtype {image.dtype}")
        shape = (image.shape[0], image.shape[1])
        object.__setattr__(self, "image", image)
        object.__setattr__(self, "sparse", _depth_map("sparse", self.sparse, shape))
        if self.target is not None:
            object.__setattr__(self, "target", _depth_map("target", self.target, shape))
        if self.K is not None:
            K = np.asarray(self.K, dtype=np.float64)
            if K.shape != (3, 3):
                raise ValueError(f"K: expected a (3, 3) camera matrix, got shape {K.shape}")
            object.__setattr__(self, "K", K)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.image.shape[0], self.image.shape[1]


@dataclass(frozen=True)
class CompletedDepth:
    """Output of completion; all maps (H, W) float32.

    depth       metres along the optical axis, 0 = no value
    foreground  near surface d1 in metres (thesis Eq. 4.5), or None from a method with one surface
    background  far surface d2 in metres, or None
    sigma       weight of the *foreground* in [0, 1]: depth = sigma * foreground + (1 - sigma) * background, or None
    """

    depth: FloatMap
    foreground: FloatMap | None = None
    background: FloatMap | None = None
    sigma: FloatMap | None = None

    def __post_init__(self) -> None:
        depth = _depth_map("depth", self.depth)
        object.__setattr__(self, "depth", depth)
        twin = (self.foreground, self.background, self.sigma)
        if any(part is None for part in twin):
            if any(part is not None for part in twin):
                raise ValueError("foreground, background and sigma belong together: give all three or none")
            return
        shape = (depth.shape[0], depth.shape[1])
        object.__setattr__(self, "foreground", _depth_map("foreground", self.foreground, shape))
        object.__setattr__(self, "background", _depth_map("background", self.background, shape))
        sigma = _depth_map("sigma", self.sigma, shape)
        if sigma.size and float(sigma.max()) > 1:
            raise ValueError(f"sigma: largest value is {float(sigma.max()):g}; it is a weight in [0, 1]")
        object.__setattr__(self, "sigma", sigma)

    @property
    def has_surfaces(self) -> bool:
        """True when the method gave two surfaces and sigma (TWISE), False for one surface (DC, classical)."""
        return self.sigma is not None

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.depth.shape[0], self.depth.shape[1]
