"""Twin surface representation: foreground, background and the foreground's weight sigma (thesis Eq. 2.3, 4.5).

Every function takes NumPy arrays or torch tensors alike and returns the same kind.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

Array = TypeVar("Array", NDArray[np.floating], torch.Tensor)

# Thesis Table 4.6: learned sigma, sigma = 1, sigma = 0, sigma = 1/2, and the choice of one surface by sigma > 1/2.
DECODINGS = ("fused", "foreground", "background", "mean", "hard")


def split_head(output: torch.Tensor, depth_unit: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Network output (B, 3, H, W) -> foreground, background (metres, rectified) and sigma in [0, 1], each (B, H, W)."""
    if output.ndim != 4 or output.shape[1] != 3:
        raise ValueError(f"twin surface output: expected (B, 3, H, W), got {tuple(output.shape)}")
    surfaces = output[:, :2].clamp(min=0) * depth_unit
    return surfaces[:, 0], surfaces[:, 1], torch.sigmoid(output[:, 2])


def fuse(foreground: Array, background: Array, sigma: Array, decoding: str = "fused") -> Array:
    """One depth from two surfaces; all three of one shape, depth >= 0 in any unit.

    decoding  "fused": sigma d1 + (1 - sigma) d2 (Eq. 4.5); "foreground": d1; "background": d2; "mean": their mean;
              "hard": d1 where sigma > 0.5, else d2. ValueError for any other.
    """
    if decoding not in DECODINGS:
        raise ValueError(f"decoding: expected one of {', '.join(DECODINGS)}, got {decoding!r}")
    if foreground.shape != background.shape or foreground.shape != sigma.shape:
        raise ValueError(f"shapes differ: {foreground.shape}, {background.shape} and sigma {sigma.shape}")
    if decoding == "foreground":
        return foreground
    if decoding == "background":
        return background
    if decoding == "mean":
        return (foreground + background) / 2
    if decoding == "fused":
        return sigma * foreground + (1 - sigma) * background
    if isinstance(sigma, torch.Tensor):
        return torch.where(sigma > 0.5, foreground, background)
    return np.where(sigma > 0.5, foreground, background)
