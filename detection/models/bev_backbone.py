"""The 2D network of SECOND and PointPillars on a bird's-eye map: blocks down, transposed convolutions up."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from detection.models.fully_connected import EPS, MOMENTUM


@dataclass(frozen=True)
class BevSettings:
    """Per block: convolutions after the first, stride of the first, channels, upsampling and channels after it."""

    layers: tuple[int, ...]
    strides: tuple[int, ...]
    channels: tuple[int, ...]
    up_strides: tuple[int, ...]
    up_channels: tuple[int, ...]

    @property
    def out_channels(self) -> int:
        """Channels of the concatenated map."""
        return sum(self.up_channels)

    def cells(self, before: int) -> int:
        """Cells along an axis of the concatenated map, from those of the input map."""
        return ((before - 1) // self.strides[0] + 1) * self.up_strides[0]


def _block(in_channels: int, channels: int, stride: int, layers: int) -> nn.Sequential:
    """Padding at index 0, then convolution, normalisation, ReLU at 1 2 3, 4 5 6, ..."""
    modules: list[nn.Module] = [nn.ZeroPad2d(1), nn.Conv2d(in_channels, channels, 3, stride=stride, bias=False)]
    modules += [nn.BatchNorm2d(channels, EPS, MOMENTUM), nn.ReLU(inplace=True)]
    for _ in range(layers):
        modules.append(nn.Conv2d(channels, channels, 3, padding=1, bias=False))
        modules += [nn.BatchNorm2d(channels, EPS, MOMENTUM), nn.ReLU(inplace=True)]
    return nn.Sequential(*modules)


def _deblock(in_channels: int, channels: int, stride: int) -> nn.Sequential:
    up = nn.ConvTranspose2d(in_channels, channels, stride, stride=stride, bias=False)
    return nn.Sequential(up, nn.BatchNorm2d(channels, EPS, MOMENTUM), nn.ReLU(inplace=True))


class BevBackbone(nn.Module):
    """Multi-scale 2D convolutions; every block's map is brought to one size and all are concatenated."""

    def __init__(self, in_channels: int, settings: BevSettings) -> None:
        super().__init__()
        inputs = (in_channels, *settings.channels[:-1])
        self.blocks = nn.ModuleList(
            _block(*block) for block in zip(inputs, settings.channels, settings.strides, settings.layers)
        )
        self.deblocks = nn.ModuleList(
            _deblock(*block) for block in zip(settings.channels, settings.up_channels, settings.up_strides)
        )
        self.out_channels = settings.out_channels

    def forward(self, bev: Tensor) -> Tensor:
        """(B, C, Y, X) -> (B, out_channels, Y / s, X / s), s = first stride / first upsampling."""
        ups = []
        for block, deblock in zip(self.blocks, self.deblocks):
            bev = block(bev)
            ups.append(deblock(bev))
        return torch.cat(ups, dim=1)
