"""A small segmentation network of our own, for scenes like the synthetic ones and without any download.

    image 1/1 -> 1/2 (16) -> 1/4 (32) -> 1/8 (96): six separable blocks, dilated 1 2 4 8 4 2 -> 1/4 (48) -> 19 classes

The logits are a quarter of the image wide and high; labels come from their bilinear enlargement.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.semantics.conventions import CLASSES
from pipeline.semantics.pictures import IMAGENET


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """3x3 convolution, batch norm, ReLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class SeparableBlock(nn.Module):
    """Residual block: dilated depthwise 3x3, then 1x1 (Howard et al. 2017; dilation as Yu and Koltun 2016)."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.spatial = nn.Conv2d(channels, channels, 3, 1, dilation, dilation, groups=channels, bias=False)
        self.spatial_norm = nn.BatchNorm2d(channels)
        self.mix = nn.Conv2d(channels, channels, 1, bias=False)
        self.mix_norm = nn.BatchNorm2d(channels)

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, h, w) -> the same shape."""
        spatial = F.relu(self.spatial_norm(self.spatial(features)))
        return F.relu(features + self.mix_norm(self.mix(spatial)))


class StreetSegmenter(nn.Module):
    """About 130,000 parameters; see the figure at the top of this file."""

    normalisation = IMAGENET
    # Type of values in files.
    stored = torch.float32
    # For cards: nothing but our own training went into it.
    origin = ""

    def __init__(self, classes: int = len(CLASSES), channels: int = 96) -> None:
        super().__init__()
        self.to_half = _conv(3, 16, stride=2)
        self.to_quarter = _conv(16, 32, stride=2)
        self.to_eighth = _conv(32, channels, stride=2)
        self.context = nn.Sequential(*[SeparableBlock(channels, dilation) for dilation in (1, 2, 4, 8, 4, 2)])
        self.narrow = nn.Conv2d(channels, 48, 1)
        self.skip = nn.Conv2d(32, 48, 1)
        self.refine = SeparableBlock(48, 1)
        self.classify = nn.Conv2d(48, classes, 1)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) normalised RGB -> (B, 19, ceil(H / 4), ceil(W / 4)) logits."""
        quarter = self.to_quarter(self.to_half(image))
        eighth = self.context(self.to_eighth(quarter))
        enlarged = F.interpolate(self.narrow(eighth), size=quarter.shape[-2:], mode="bilinear", align_corners=False)
        return self.classify(self.refine(F.relu(enlarged + self.skip(quarter))))

    def parameter_groups(self, rate: float) -> list[dict[str, Any]]:
        """One group of parameters and its learning rate, for an optimiser."""
        return [{"params": list(self.parameters()), "lr": rate}]
