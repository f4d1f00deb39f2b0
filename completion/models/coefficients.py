"""Networks with Depth Coefficients at the input, the output, or both (thesis chapter 3).

`CoefficientNetwork` follows the layer plan of Imran et al., "Depth Coefficients for Depth Completion" (CVPR 2019), as
its authors coded it; `CoefficientSparseToDense` is the sparse-to-dense ResNet with coefficient input or head, for the
2x2 comparison of Table 3.3.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from completion.depth_coefficients import Bins, encode
from completion.models.blocks import require_multiple
from completion.models.resnet import block_counts, conv3, resnet_layer
from completion.models.sparse_to_dense import SCALE, WIDTH, Backbone

DEPTH_FEATURES, COLOUR_FEATURES = 80, 48


def encode_map(sparse: Tensor, bins: Bins) -> Tensor:
    """Sparse depth (B, 1, H, W) in metres -> coefficients (B, channels, H, W), zero vectors where there is none."""
    return encode(sparse[:, 0], bins).permute(0, 3, 1, 2)


class _Step(nn.Module):
    """Nearest-neighbour resize to the skip's size, conv3x3, BN, ReLU, then [decoder, skip]."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv, self.norm = conv3(inputs, outputs), nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        x = F.interpolate(x, size=skip.shape[-2:], mode="nearest")
        return torch.cat((F.relu(self.norm(self.conv(x))), skip), 1)


class CoefficientNetwork(nn.Module):
    """`forward(sparse in metres, rgb / 255) -> (logits, auxiliary)`, (B, channels, H, W) and the same at 1/16.

    In evaluation mode the auxiliary head is left out. H and W must be multiples of 16. The authors fed BGR; weights
    trained here take RGB.
    """

    def __init__(self, layers: int = 18, count: int = 80, size: float = 1.0, layout: str = "guard") -> None:
        super().__init__()
        self.bins = Bins(count, size, layout)
        blocks, both = block_counts(layers), DEPTH_FEATURES + COLOUR_FEATURES
        self.depth_input = conv3(self.bins.channels, DEPTH_FEATURES)
        self.colour_input = nn.Sequential(conv3(3, COLOUR_FEATURES), nn.BatchNorm2d(COLOUR_FEATURES), nn.ReLU())
        self.encoder1 = resnet_layer(both, 128, blocks[0], 1)
        self.encoder2 = resnet_layer(128, 128, blocks[1], 2)
        self.encoder3 = resnet_layer(128, 256, blocks[2], 2)
        self.encoder4 = resnet_layer(256, 512, blocks[3], 2)
        self.bottom = nn.Sequential(conv3(512, 512, 2), nn.BatchNorm2d(512), nn.ReLU())
        self.decoder4 = _Step(512, 256)
        self.decoder3 = _Step(256 + 512, 128)
        self.decoder2 = _Step(128 + 256, 64)
        self.decoder1 = _Step(64 + 128, 64)
        self.decoder0 = _Step(64 + 128, 64)
        self.head = nn.Conv2d(64 + both, self.bins.channels, 1)
        self.auxiliary = nn.Conv2d(512, self.bins.channels, 1)

    def forward(self, sparse: Tensor, rgb: Tensor) -> tuple[Tensor, ...]:
        require_multiple(sparse, rgb, 16)
        depth = F.relu(self.depth_input(encode_map(sparse, self.bins)))
        x0 = torch.cat((self.colour_input(rgb), depth), 1)
        x1 = self.encoder1(x0)
        x2 = self.encoder2(x1)
        x3 = self.encoder3(x2)
        x4 = self.encoder4(x3)
        bottom = self.bottom(x4)
        y = self.decoder4(bottom, x4)
        y = self.decoder3(y, x3)
        y = self.decoder2(y, x2)
        y = self.decoder1(y, x1)
        y = self.decoder0(y, x0)
        logits = self.head(y)
        return (logits, self.auxiliary(bottom)) if self.training else (logits,)


class CoefficientSparseToDense(Backbone):
    """Sparse-to-dense ResNet with coefficients at input or output: `forward(sparse in metres, rgb) -> (out,)`.

    coefficient_input  the depth branch takes coefficients (True) or the sparse map (False)
    coefficient_head   out is logits (B, channels, H, W), or metres (B, 1, H, W) without the published 0.9 m rule
    """

    def __init__(
        self,
        layers: int = 18,
        coefficient_input: bool = True,
        coefficient_head: bool = True,
        count: int = 80,
        size: float = 1.0,
        layout: str = "guard",
        width: int = WIDTH,
    ) -> None:
        bins = Bins(count, size, layout)
        heads, depth_channels = (bins.channels if coded else 1 for coded in (coefficient_head, coefficient_input))
        super().__init__(layers, heads, depth_channels, width=width)
        self.bins, self.coefficient_input, self.coefficient_head = bins, coefficient_input, coefficient_head

    def forward(self, sparse: Tensor, rgb: Tensor) -> tuple[Tensor]:
        require_multiple(sparse, rgb, 16)
        depth = encode_map(sparse, self.bins) if self.coefficient_input else sparse
        head = self.decode(depth, self.colours(rgb))
        return (head if self.coefficient_head else SCALE * head,)
