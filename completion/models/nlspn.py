"""NLSPN: Park, Joo, Hu, Liu, Kweon, "Non-Local Spatial Propagation Network for Depth Completion" (ECCV 2020).

A ResNet encoder-decoder predicts an initial depth, its confidence and guidance; from the guidance each pixel gets
neighbours anywhere (offsets) and affinities to them, along which the depth is propagated. Layer names are those of the
published state dictionary.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from completion.models.blocks import require_multiple
from completion.models.deformable import cells, propagate, times_confidence, with_centre
from completion.models.resnet import block_counts, resnet_layer

AFFINITIES = ("AS", "ASS", "TC", "TGASS")
WIDTH = 64  # features of the published networks at full resolution
GAMMA = 0.5  # the learned scale of TGASS starts at this share of the neighbours


class Operations(NamedTuple):
    """What computes the two deformable operations; see `completion.models.deformable` for both."""

    times_confidence: Callable[[Tensor, Tensor, Tensor], Tensor]
    propagate: Callable[[Tensor, Tensor, Tensor, int, Tensor | None], tuple[Tensor, ...]]


TORCH = Operations(times_confidence, propagate)


class Propagated(NamedTuple):
    """steps: the depth (B, 1, H, W) after each iteration, not clamped; offsets (B, 2 K^2, H, W), rows before columns,
    and weights (B, K^2, H, W), both in reading order with the centre."""

    steps: tuple[Tensor, ...]
    offsets: Tensor
    weights: Tensor


class Outputs(NamedTuple):
    """Everything the network computes, (B, ., H, W): depth in metres, >= 0; initial may be negative."""

    depth: Tensor
    initial: Tensor
    guidance: Tensor
    confidence: Tensor | None
    propagated: Propagated


class NonLocalPropagation(nn.Module):
    """Guidance (B, K^2 - 1, H, W) -> offsets and weights of K^2 - 1 neighbours; `iterations` steps along them.

    affinity    how raw affinities a are bounded, S = sum |a| + 1e-4 over the neighbours: "AS" a / S; "ASS" a / S where
                S > 1; "TC" tanh(a) / n; "TGASS" tanh(a) / g as ASS, g learned
    legacy      the published weights were trained so: a neighbour's cell is added to its offset, so that its confidence
                is read where it lies, but depth two cells away; without it, depth at the cell and the confidence at
                p + offset, as if the neighbour lay at the centre. Both as published; no effect without confidence
    preserve_input  measured depth replaces the map before each iteration
    """

    def __init__(self, kernel: int, affinity: str, iterations: int, legacy: bool, preserve_input: bool) -> None:
        super().__init__()
        if kernel < 3 or kernel % 2 == 0:
            raise ValueError(f"kernel: expected an odd number >= 3, got {kernel}")
        if affinity not in AFFINITIES:
            raise ValueError(f"affinity: expected one of {', '.join(AFFINITIES)}, got {affinity!r}")
        if iterations < 1:
            raise ValueError(f"iterations: expected >= 1, got {iterations}")
        self.kernel, self.affinity, self.iterations = kernel, affinity, iterations
        self.legacy, self.preserve_input = legacy, preserve_input
        n = kernel**2 - 1
        self.conv_offset_aff = nn.Conv2d(n, 3 * n, 3, padding=1)
        nn.init.zeros_(self.conv_offset_aff.weight)
        nn.init.zeros_(self.conv_offset_aff.bias)  # type: ignore[arg-type]
        scale = {"TC": float(n), "TGASS": GAMMA * n}.get(affinity, 1.0)
        self.aff_scale_const = nn.Parameter(torch.full((1,), scale), requires_grad=affinity == "TGASS")
        # Constants of the published deformable convolutions; here they only keep the state dictionary whole.
        self.w = nn.Parameter(torch.ones(1, 1, kernel, kernel), requires_grad=False)
        self.b = nn.Parameter(torch.zeros(1), requires_grad=False)
        self.w_conf = nn.Parameter(torch.ones(1, 1, 1, 1), requires_grad=False)

    def forward(
        self, depth: Tensor, guidance: Tensor, confidence: Tensor | None, sparse: Tensor, operations: Operations = TORCH
    ) -> Propagated:
        """Initial depth, confidence and sparse (B, 1, H, W). Computed in float32 also under autocast."""
        with torch.autocast(depth.device.type, enabled=False):
            kind = torch.promote_types(depth.dtype, torch.float32)
            depth, guidance, sparse = depth.to(kind), guidance.to(kind), sparse.to(kind)
            offsets, affinities = self.raw(guidance)
            if confidence is not None:
                if self.legacy:
                    offsets = offsets + self._cells(offsets)
                affinities = operations.times_confidence(affinities, confidence.to(kind), offsets)
            affinities = self.normalise(affinities)
            weights = with_centre(affinities, 1 - affinities.sum(1, keepdim=True))
            offsets = with_centre(offsets, torch.zeros_like(offsets[:, :1]))
            kept = sparse if self.preserve_input else None
            steps = operations.propagate(depth, offsets, weights, self.iterations, kept)
        return Propagated(steps, offsets.flatten(1, 2), weights)

    def raw(self, guidance: Tensor) -> tuple[Tensor, Tensor]:
        """Offsets (B, n, 2, H, W) and affinities (B, n, H, W), the latter after the tanh of TC and TGASS."""
        n = self.kernel**2 - 1
        offsets, affinities = self.conv_offset_aff(guidance).split((2 * n, n), 1)
        if self.affinity == "TC":
            affinities = torch.tanh(affinities) / self.aff_scale_const
        elif self.affinity == "TGASS":
            affinities = torch.tanh(affinities) / (self.aff_scale_const + 1e-8)
        return offsets.unflatten(1, (n, 2)), affinities

    def normalise(self, affinities: Tensor) -> Tensor:
        """Affinities of the neighbours, bounded so that their absolute sum is at most (AS: nearly) 1."""
        if self.affinity == "TC":
            return affinities
        total = affinities.abs().sum(1, keepdim=True) + 1e-4
        return affinities / (total if self.affinity == "AS" else total.clamp(min=1))

    def _cells(self, offsets: Tensor) -> Tensor:
        """(n, 2, 1, 1)"""
        around = cells(self.kernel)
        del around[len(around) // 2]
        return torch.tensor(around, dtype=offsets.dtype, device=offsets.device)[:, :, None, None]


def _activated(layer: nn.Module, channels: int = 0) -> nn.Sequential:
    """A convolution, batch normalisation if `channels` is given, leaky ReLU."""
    norm = (nn.BatchNorm2d(channels),) if channels else ()
    return nn.Sequential(layer, *norm, nn.LeakyReLU(0.2))


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return _activated(nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False), outputs)


def _up(inputs: int, outputs: int) -> nn.Sequential:
    return _activated(nn.ConvTranspose2d(inputs, outputs, 3, 2, padding=1, output_padding=1, bias=False), outputs)


def _join(decoded: Tensor, skip: Tensor) -> Tensor:
    """Concatenated, what the decoder has more at the bottom and the right cut off (sizes that are odd somewhere)."""
    return torch.cat((decoded[..., : skip.shape[-2], : skip.shape[-1]], skip), 1)


class NLSPN(nn.Module):
    """`forward(sparse in metres, rgb standardised) -> (B, 1, H, W)` metres, >= 0; any H and W.

    layers      34 or 18, of the ResNet
    width       features at full resolution (published: 64, a multiple of 4); every layer scales with it
    confidence  predict it and weigh the affinities by it (published)
    The others: see `NonLocalPropagation`; the defaults are the authors' current code and their training commands.
    """

    def __init__(
        self,
        layers: int = 34,
        width: int = WIDTH,
        kernel: int = 3,
        affinity: str = "TGASS",
        iterations: int = 18,
        confidence: bool = True,
        legacy: bool = False,
        preserve_input: bool = True,
    ) -> None:
        super().__init__()
        if width < 4 or width % 4:
            raise ValueError(f"width: expected a multiple of 4, got {width}")
        blocks = block_counts(layers)
        w1, w2, w4, w8 = width, 2 * width, 4 * width, 8 * width
        self.conv1_rgb = _activated(nn.Conv2d(3, w1 - w1 // 4, 3, padding=1))
        self.conv1_dep = _activated(nn.Conv2d(1, w1 // 4, 3, padding=1))
        self.conv2 = resnet_layer(w1, w1, blocks[0], 1)
        self.conv3 = resnet_layer(w1, w2, blocks[1], 2)
        self.conv4 = resnet_layer(w2, w4, blocks[2], 2)
        self.conv5 = resnet_layer(w4, w8, blocks[3], 2)
        self.conv6 = _conv(w8, w8, stride=2)
        self.dec5 = _up(w8, w4)
        self.dec4 = _up(w4 + w8, w2)
        self.dec3 = _up(w2 + w4, w1)
        self.dec2 = _up(w1 + w2, w1)
        self.id_dec1 = _conv(w1 + w1, w1)
        self.id_dec0 = _activated(nn.Conv2d(w1 + w1, 1, 3, padding=1))
        self.gd_dec1 = _conv(w1 + w1, w1)
        self.gd_dec0 = nn.Sequential(nn.Conv2d(w1 + w1, kernel**2 - 1, 3, padding=1))
        self.has_confidence = confidence
        if confidence:
            self.cf_dec1 = _conv(w1 + w1, w1 // 2)
            self.cf_dec0 = nn.Sequential(nn.Conv2d(w1 // 2 + w1, 1, 3, padding=1), nn.Sigmoid())
        self.prop_layer = NonLocalPropagation(kernel, affinity, iterations, legacy, preserve_input)

    def forward(self, sparse: Tensor, rgb: Tensor) -> Tensor:
        return self.outputs(sparse, rgb).depth

    def outputs(self, sparse: Tensor, rgb: Tensor, operations: Operations = TORCH) -> Outputs:
        """Depth and all that leads to it. ValueError for other shapes than (B, 1, H, W) and (B, 3, H, W)."""
        require_multiple(sparse, rgb, 1)
        initial, guidance, confidence = self.heads(sparse, rgb)
        propagated = self.prop_layer(initial, guidance, confidence, sparse, operations)
        return Outputs(propagated.steps[-1].clamp(min=0), initial, guidance, confidence, propagated)

    def heads(self, sparse: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Initial depth (B, 1, H, W), guidance (B, K^2 - 1, H, W) and confidence (B, 1, H, W) or None."""
        f1 = torch.cat((self.conv1_rgb(rgb), self.conv1_dep(sparse)), 1)
        f2 = self.conv2(f1)
        f3 = self.conv3(f2)
        f4 = self.conv4(f3)
        f5 = self.conv5(f4)
        y = self.dec5(self.conv6(f5))
        y = self.dec4(_join(y, f5))
        y = self.dec3(_join(y, f4))
        y = _join(self.dec2(_join(y, f3)), f2)
        initial = self.id_dec0(_join(self.id_dec1(y), f1))
        guidance = self.gd_dec0(_join(self.gd_dec1(y), f1))
        confidence = self.cf_dec0(_join(self.cf_dec1(y), f1)) if self.has_confidence else None
        return initial, guidance, confidence
