"""MultiStack (MSG-CHN) and TWISE: three small hourglasses from coarse to fine, guided by one colour encoder.

Li et al., "A Multi-Scale Guided Cascade Hourglass Network for Depth Completion", WACV 2020; Imran et al., "Depth
Completion with Twin Surface Extrapolation at Occlusion Boundaries", CVPR 2021 (thesis section 4.4). Stages are numbered
as in the published state dictionaries: 1 = quarter, 2 = half, 3 = full resolution.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from completion.models.blocks import (
    DepthDecoder,
    DepthEncoder,
    RgbEncoder,
    Triple,
    initialise,
    require_multiple,
    upsample2,
)


class Hourglasses(nn.Module):
    """The layers both networks share.

    channels     width of every layer (published: 64 for TWISE, 32 for MSG-CHN)
    heads        output channels of each stage (1: depth; 3: foreground, background, sigma logit)
    pooling      "avg" or "max": how the sparse map is reduced to 1/2 and 1/4
    extra_skips  hand all three decoder features on to the next stage rather than the last one only
    """

    def __init__(self, channels: int, heads: int, pooling: str, extra_skips: bool, init: str) -> None:
        super().__init__()
        if pooling not in ("avg", "max"):
            raise ValueError(f"pooling: expected 'avg' or 'max', got {pooling!r}")
        self.pooling = pooling
        self.extra_skips = extra_skips
        self.rgb_encoder = RgbEncoder(channels)
        self.depth_encoder1 = DepthEncoder(1, channels)
        self.depth_decoder1 = DepthDecoder(channels, heads)
        self.depth_encoder2 = DepthEncoder(2, channels)
        self.depth_decoder2 = DepthDecoder(channels, heads)
        self.depth_encoder3 = DepthEncoder(2, channels)
        self.depth_decoder3 = DepthDecoder(channels, heads)
        initialise(self, init)

    def pool(self, sparse: Tensor, factor: int) -> Tensor:
        """Sparse depth (B, 1, H, W) -> (B, 1, H/factor, W/factor), over measured pixels only."""
        if self.pooling == "max":
            return F.max_pool2d(sparse, factor)
        measured = (sparse > 0).to(sparse.dtype)
        # The published constant; one sample in 4x4 pixels is thereby scaled by 0.9984.
        return F.avg_pool2d(sparse, factor) / (F.avg_pool2d(measured, factor) + 1e-4)

    def handed_on(self, features: Triple) -> tuple[Tensor, ...]:
        """Decoder features that the next stage's encoder receives."""
        return features if self.extra_skips else features[:1]


def twin_fuse(head: Tensor) -> Tensor:
    """(B, 3, h, w) raw head -> (B, 1, h, w): sigmoid(l) d1 + (1 - sigmoid(l)) d2, without rectification."""
    sigma = torch.sigmoid(head[:, 2:3])
    return sigma * head[:, 0:1] + (1 - sigma) * head[:, 1:2]


def _add_surfaces(head: Tensor, surfaces: Tensor) -> Tensor:
    """Add (B, 2, h, w) to the surfaces of a (B, 3, h, w) head; the sigma logit is never residual."""
    return torch.cat((head[:, :2] + surfaces, head[:, 2:]), 1)


class Twise(Hourglasses):
    """Twin surface extrapolation: `forward(sparse / 80, rgb / 255) -> (out_1, out_2, out_4)`.

    Outputs are (B, 3, H, W), (B, 3, H/2, W/2), (B, 3, H/4, W/4): foreground and background in units of 80 m, and the
    logit of the foreground's weight sigma. H and W must be multiples of 16. An all-zero sparse map is allowed.
    """

    def __init__(
        self, channels: int = 64, pooling: str = "avg", extra_skips: bool = False, init: str = "xavier"
    ) -> None:
        super().__init__(channels, 3, pooling, extra_skips, init)

    def forward(self, sparse: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        require_multiple(sparse, rgb, 16)
        c0, c1, c2, c3, c4 = self.rgb_encoder(rgb)

        # quarter resolution
        depth = self.depth_encoder1(self.pool(sparse, 4))
        head4, features = self.depth_decoder1(depth, (c2, c3, c4))
        out4 = head4

        # half resolution, guided by the fused quarter prediction
        guide2 = upsample2(twin_fuse(head4))
        depth = self.depth_encoder2(torch.cat((self.pool(sparse, 2), guide2), 1), self.handed_on(features))
        head2, features = self.depth_decoder2(depth, (c1, c2, c3))
        out2 = _add_surfaces(head2, upsample2(head4[:, :2]))

        # full resolution; the guide accumulates f(head) rather than fusing out2
        guide1 = upsample2(twin_fuse(head2) + guide2)
        depth = self.depth_encoder3(torch.cat((sparse, guide1), 1), self.handed_on(features))
        head1, _ = self.depth_decoder3(depth, (c0, c1, c2))
        out1 = _add_surfaces(head1, upsample2(out2[:, :2]))
        return out1, out2, out4


class MultiStack(Hourglasses):
    """MSG-CHN: `forward(sparse in metres, rgb / 255) -> (out_1, out_2, out_4)`, each (B, 1, H, W) in metres.

    Published code: 32 channels with the extra skips; the paper's and the thesis' baseline: 64 without them. H and W
    must be multiples of 16.
    """

    def __init__(
        self, channels: int = 32, pooling: str = "avg", extra_skips: bool = True, init: str = "xavier"
    ) -> None:
        super().__init__(channels, 1, pooling, extra_skips, init)

    def forward(self, sparse: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        require_multiple(sparse, rgb, 16)
        c0, c1, c2, c3, c4 = self.rgb_encoder(rgb)

        depth = self.depth_encoder1(self.pool(sparse, 4))
        head4, features = self.depth_decoder1(depth, (c2, c3, c4))

        guide2 = upsample2(head4)
        depth = self.depth_encoder2(torch.cat((self.pool(sparse, 2), guide2), 1), self.handed_on(features))
        head2, features = self.depth_decoder2(depth, (c1, c2, c3))

        guide1 = upsample2(head2 + guide2)
        depth = self.depth_encoder3(torch.cat((sparse, guide1), 1), self.handed_on(features))
        head1, _ = self.depth_decoder3(depth, (c0, c1, c2))

        out4 = F.interpolate(head4, scale_factor=4, mode="bilinear", align_corners=True)
        return head1 + guide1, guide1, out4
