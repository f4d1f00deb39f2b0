"""From arrays to the tensors a network takes, in its own units."""

from __future__ import annotations

import torch
from torch import Tensor

# ImageNet statistics of RGB in [0, 1].
RGB_MEAN = (0.485, 0.456, 0.406)
RGB_DEVIATION = (0.229, 0.224, 0.225)


def scale_rgb(rgb: Tensor, scaling: str) -> Tensor:
    """RGB (B, 3, H, W) in 0..255 (any dtype) -> float32 in the network's scaling.

    scaling  "unit": / 255; "standardised": / 255, minus the ImageNet mean, over its deviation; "raw": unchanged
    """
    values = rgb.to(torch.float32)
    if scaling == "raw":
        return values
    if scaling == "unit":
        return values / 255
    if scaling == "standardised":
        mean = torch.tensor(RGB_MEAN, device=rgb.device).view(1, 3, 1, 1)
        deviation = torch.tensor(RGB_DEVIATION, device=rgb.device).view(1, 3, 1, 1)
        return (values / 255 - mean) / deviation
    raise ValueError(f"rgb scaling: expected 'unit', 'standardised' or 'raw', got {scaling!r}")
