"""Depth Coefficients on top of the two LiDAR rings round every pixel: the bundled DC network.

The published networks get the coefficients of the sparse map and learn everything from there (thesis chapter 3). Here
the two samples that enclose a pixel and the interpolation between them are written as coefficients first, a third each:
at an edge that is already a distribution with two modes. A compact U-Net adds logits to theirs, so an untrained network
is the ring interpolation, and training decides between the modes.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from completion.depth_coefficients import Bins
from completion.models.blocks import require_multiple
from completion.models.coefficients import encode_map
from completion.models.rings import Rings, find_rings
from completion.models.selection import INPUTS, PixelUNet, depth_features

# Probability of a bin that no sample speaks for, before training: all 82 weigh an eighth of what one sample does.
FLOOR = 5e-4


class RingCoefficients(nn.Module):
    """`forward(sparse, rgb) -> (logits,)`: sparse (B, 1, H, W) metres, rgb (B, 3, H, W) standardised.

    logits (B, channels, H, W), to be trained by cross-entropy (Eq. 3.3). H and W must be multiples of 32.
    `completion.cpu.ring_coefficients` does the same faster for inference on the CPU.

    width        features at half resolution; those of `Selection` at the same width can be a start
    count, size  see `Bins`; always with guard bins
    """

    def __init__(self, width: int = 24, count: int = 80, size: float = 1.0) -> None:
        super().__init__()
        self.bins = Bins(count, size)
        self.network = PixelUNet(INPUTS, self.bins.channels, width)

    def forward(self, sparse: Tensor, rgb: Tensor) -> tuple[Tensor]:
        require_multiple(sparse, rgb, 32)
        rings = find_rings(sparse)
        correction = self.network(torch.cat((rgb, depth_features(sparse, rings)), 1))
        return (correction.float() + torch.log(ring_coefficients(rings, self.bins) + FLOOR),)


def ring_coefficients(rings: Rings, bins: Bins) -> Tensor:
    """(B, channels, H, W): mean of the coefficients of the sample above, the one below and their interpolation."""
    above, below, between = (encode_map(depth, bins) for depth in (rings.above, rings.below, rings.between))
    return (above + below + between) / 3
