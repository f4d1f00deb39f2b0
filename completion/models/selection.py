"""The bundled network: a distribution over a few measured depths at every pixel.

TWISE regresses two surfaces, which takes long training before they leave the mean of an edge. Here a compact U-Net says
how likely each of ten candidates is: the sample above, the one below and the interpolation of the two, at the pixel
and six columns to either side, and one depth the network draws itself (sky line, no samples at all). Training
maximises the likelihood of the truth (`completion.mixture`); the twin surfaces are quantiles of the distribution, which
are what ALE and RALE converge to (thesis Eq. 4.2-4.6), and sigma is the probability of the near one. As in Depth
Coefficients (thesis chapter 3) a bimodal pixel keeps both modes: no depth between two objects has to be learned away.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from completion.models.blocks import require_multiple
from completion.models.rings import Rings, find_rings

COLUMN_SHIFTS = (0, -6, 6)
CANDIDATES = 3 * len(COLUMN_SHIFTS) + 1
# Channels of the input: colours and `depth_features`.
INPUTS = 10
# Channels of the output: weights (logits), natural log of depth in metres, and one log scale.
CHANNELS = 2 * CANDIDATES + 1


class Residual(nn.Module):
    """Two 3 x 3 convolutions beside an identity; starts as the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)
        nn.init.zeros_(self.conv2.weight)
        nn.init.zeros_(self.conv2.bias if self.conv2.bias is not None else torch.zeros(channels))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv2(F.relu(self.conv1(F.relu(x))))


class PixelUNet(nn.Module):
    """(B, inputs, H, W) -> (B, outputs, H, W): a U-Net from 1/2 to 1/32 whose ends are pixel shuffles.

    Nothing is computed at full resolution but the first and the last rearrangement, which keeps every pixel's detail
    at a quarter of the cost.
    """

    def __init__(self, inputs: int, outputs: int, width: int) -> None:
        super().__init__()
        widths = (width, width * 3 // 2, width * 2, width * 3, width * 3)
        depths = (1, 1, 2, 2, 2)
        self.stem = nn.Conv2d(4 * inputs, width, 3, padding=1)
        self.encoder = nn.ModuleList(
            nn.Sequential(*(Residual(channels) for _ in range(depth))) for channels, depth in zip(widths, depths)
        )
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in itertools.pairwise(widths))
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in itertools.pairwise(widths))
        self.decoder = nn.ModuleList(Residual(channels) for channels in widths[:-1])
        self.head = nn.Conv2d(width, 4 * outputs, 1)
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.zeros_(self.head.bias if self.head.bias is not None else torch.zeros(4 * outputs))

    def forward(self, x: Tensor) -> Tensor:
        return F.pixel_shuffle(self.at_half(F.pixel_unshuffle(x, 2)), 2)

    def at_half(self, x: Tensor) -> Tensor:
        """(B, 4 inputs, H/2, W/2) -> (B, 4 outputs, H/2, W/2): the convolutions alone, between the two shuffles."""
        x = self.stem(x)
        skips = []
        for stage, down in zip(self.encoder, self.down):
            x = stage(x)
            skips.append(x)
            x = down(x)
        x = self.encoder[len(self.down)](x)
        for up, decoder in zip(reversed(self.up), reversed(self.decoder)):
            x = decoder(skips.pop() + F.interpolate(up(x), scale_factor=2.0, mode="nearest"))
        head: Tensor = self.head(F.relu(x))
        return head


class Selection(nn.Module):
    """`forward(sparse, rgb) -> (mixture,)`: sparse (B, 1, H, W) metres, rgb (B, 3, H, W) standardised.

    mixture (B, 21, H, W): ten logits, ten natural logs of depth in metres, one log scale; see `completion.mixture`.
    H and W must be multiples of 32. `network.at_half` is plain convolutions and can be exported; the rest is
    arithmetic, which `completion.cpu.selection` repeats faster for inference on the CPU.

    width     features at half resolution (24: 0.73 M parameters)
    residual  largest relative correction of a measured candidate (0.1: about 10 %)
    """

    def __init__(self, width: int = 24, residual: float = 0.1) -> None:
        super().__init__()
        self.residual = residual
        self.network = PixelUNet(INPUTS, CHANNELS, width)

    def forward(self, sparse: Tensor, rgb: Tensor) -> tuple[Tensor]:
        require_multiple(sparse, rgb, 32)
        rings = find_rings(sparse)
        raw = self.network(torch.cat((rgb, depth_features(sparse, rings)), 1))
        return (self.assemble(rings, raw.float()),)

    def assemble(self, rings: Rings, raw: Tensor) -> Tensor:
        """Candidates and the network's raw output (B, 21, H, W) -> mixture (B, 21, H, W)."""
        logits, corrections, scale = raw.split((CANDIDATES, CANDIDATES, 1), 1)
        measured = torch.log(candidate_depths(rings)) + self.residual * torch.tanh(corrections[:, :-1])
        drawn = torch.log(rings.between) + corrections[:, -1:]
        return torch.cat((logits, measured, drawn, scale), 1)


def candidate_depths(rings: Rings) -> Tensor:
    """(B, 9, H, W) metres: above, below, between at each column shift."""
    maps = torch.cat((rings.above, rings.below, rings.between), 1)
    return torch.cat([_shifted(maps, shift) for shift in COLUMN_SHIFTS], 1)


def depth_features(sparse: Tensor, rings: Rings) -> Tensor:
    """(B, 7, H, W) about -1..1: log depth, what the rings add to it, how far they are, measured or not, image row."""
    log_between = torch.log(rings.between)
    differences = [(3 * (torch.log(depth) - log_between)).clamp(-3, 3) for depth in (rings.above, rings.below)]
    distances = [distance / 16 - 1 for distance in (rings.distance_above, rings.distance_below)]
    height = sparse.shape[2]
    row = torch.linspace(-1, 1, height, device=sparse.device, dtype=sparse.dtype).view(1, 1, -1, 1).expand_as(sparse)
    return torch.cat((log_between - 2.7, *differences, *distances, (sparse > 0).to(sparse.dtype), row), 1)


def _shifted(x: Tensor, columns: int) -> Tensor:
    """x[..., c + columns] at column c, the border column repeated."""
    if columns == 0:
        return x
    if columns > 0:
        return F.pad(x, (0, columns, 0, 0), mode="replicate")[..., columns:]
    return F.pad(x, (-columns, 0, 0, 0), mode="replicate")[..., :columns]
