"""Encoders and decoder shared by MultiStack and TWISE, with the layer names of the published state dictionaries.

All activations are plain ReLUs placed *before* a convolution, so features handed on as skips are linear. Convolutions
are 3x3 with padding 1 and bias.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from auglidar_base.errors import SettingsError


def upsample2(x: Tensor) -> Tensor:
    """(B, C, h, w) -> (B, C, 2h, 2w), bilinear with aligned corners."""
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)


def _stem(inputs: int, channels: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, channels, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(channels, channels, 3, padding=1),
    )


def _halving(channels: int) -> nn.Sequential:
    return nn.Sequential(
        nn.ReLU(),
        nn.Conv2d(channels, channels, 3, stride=2, padding=1),
        nn.ReLU(),
        nn.Conv2d(channels, channels, 3, padding=1),
    )


def _doubling(channels: int) -> nn.Sequential:
    return nn.Sequential(
        nn.ReLU(),
        nn.ConvTranspose2d(channels, channels, 3, stride=2, padding=1, output_padding=1),
        nn.ReLU(),
        nn.Conv2d(channels, channels, 3, padding=1),
    )


class RgbEncoder(nn.Module):
    """(B, 3, H, W) -> five feature maps of `channels` at 1, 1/2, 1/4, 1/8 and 1/16 of the size."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.init = _stem(3, channels)
        self.enc1 = _halving(channels)
        self.enc2 = _halving(channels)
        self.enc3 = _halving(channels)
        self.enc4 = _halving(channels)

    def forward(self, rgb: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        x0 = self.init(rgb)
        x1 = self.enc1(x0)
        x2 = self.enc2(x1)
        x3 = self.enc3(x2)
        x4 = self.enc4(x3)
        return x0, x1, x2, x3, x4


Triple = tuple[Tensor, Tensor, Tensor]


class DepthEncoder(nn.Module):
    """(B, inputs, h, w) -> three feature maps at 1, 1/2 and 1/4 of the size.

    `previous` holds what the coarser stage hands on, for (x0, x1, x2) in that order; each is upsampled and added.
    """

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.init = _stem(inputs, channels)
        self.enc1 = _halving(channels)
        self.enc2 = _halving(channels)

    def forward(self, depth: Tensor, previous: tuple[Tensor, ...] = ()) -> Triple:
        features = []
        x = depth
        for level, step in enumerate((self.init, self.enc1, self.enc2)):
            x = step(x)
            if level < len(previous):
                x = x + upsample2(previous[level])
            features.append(x)
        return features[0], features[1], features[2]


class DepthDecoder(nn.Module):
    """Depth and colour features of one stage -> its head, and the three decoder features (full, half, quarter)."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.dec2 = _doubling(channels)
        self.dec1 = _doubling(channels)
        self.prdct = nn.Sequential(
            nn.ReLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(channels, heads, 3, padding=1),
        )

    def forward(self, depth: Triple, colour: Triple) -> tuple[Tensor, Triple]:
        s0, s1, s2 = (d + c for d, c in zip(depth, colour))
        half = self.dec2(s2)
        full = self.dec1(s1 + half)
        return self.prdct(full + s0), (full, half, s2)


def initialise(module: nn.Module, rule: str) -> None:
    """Initialise every convolution in place.

    "xavier": Xavier-normal weights, bias 0.01 (published MSG-CHN and TWISE). "he": Kaiming-normal weights for ReLU,
    bias 0; features then keep their size through the depth of the network. "small_normal": N(0, 0.001) weights
    (published sparse-to-dense network), normalisation layers at scale 1 and shift 0.
    """
    if rule not in ("xavier", "he", "small_normal"):
        raise ValueError(f"init: expected 'xavier', 'he' or 'small_normal', got {rule!r}")
    for layer in module.modules():
        if isinstance(layer, (nn.Conv2d, nn.ConvTranspose2d)):
            if rule == "xavier":
                nn.init.xavier_normal_(layer.weight)
            elif rule == "he":
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            else:
                nn.init.normal_(layer.weight, std=1e-3)
            if layer.bias is not None:
                nn.init.constant_(layer.bias, 0.01 if rule == "xavier" else 0.0)


def require_multiple(depth: Tensor, rgb: Tensor, multiple: int) -> None:
    """ValueError unless (B, 1, H, W) and (B, 3, H, W) agree; SettingsError unless H, W are multiples of `multiple`."""
    height, width = int(depth.shape[-2]), int(depth.shape[-1])
    if depth.ndim != 4 or rgb.ndim != 4 or depth.shape[1] != 1 or rgb.shape[1] != 3 or rgb.shape[2:] != depth.shape[2:]:
        raise ValueError(
            f"expected sparse (B, 1, H, W) and colour (B, 3, H, W), got {tuple(depth.shape)} and {tuple(rgb.shape)}"
        )
    if not torch.jit.is_tracing() and (height % multiple or width % multiple):
        raise SettingsError(
            f"image size {height}x{width}: height and width must be multiples of {multiple}; "
            "completion.infer pads any image, or crop to e.g. 352x1216"
        )
