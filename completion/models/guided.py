"""The embedded network: two surfaces, each a learned selection among measured samples near the pixel.

TWISE regresses its surfaces, which needs long training before they leave the mean of an edge. Here a compact U-Net
weighs candidates instead (`candidates.py`): the foreground prefers near candidates, the background far ones, and sigma
chooses. A surface is a convex combination of samples in inverse depth (exact on planes) whose small weights are cut to
zero, so that a depth between two objects, measured by nothing, cannot arise from a small leak. Untrained, the network
is roughly linear interpolation in inverse depth with a foreground and a background reading of every edge.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from completion.models.blocks import initialise, require_multiple
from completion.models.candidates import Candidates, candidate_count, find_candidates

LOG_10M = math.log(10.0)


def _block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1), nn.ReLU())


class Residual(nn.Module):
    """Two 3x3 convolutions round an identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.conv2(F.relu(self.conv1(x))))


def _squareplus(x: Tensor) -> Tensor:
    """Smooth and positive like softplus, without a logarithm: (x + sqrt(x^2 + 4)) / 2; squareplus(t - 1 / t) = t."""
    return 0.5 * (x + torch.sqrt(x * x + 4))


class CompactUNet(nn.Module):
    """(B, inputs, H, W) -> (B, outputs, H, W); works at 1/2 to 1/32 and returns to full size by pixel shuffle."""

    def __init__(self, inputs: int, outputs: int, width: int) -> None:
        super().__init__()
        widths = (width, width * 3 // 2, width * 2, width * 3, width * 3)
        self.stem = nn.Sequential(_block(inputs * 4, width), Residual(width))
        self.down = nn.ModuleList(nn.Sequential(_block(a, b, stride=2), Residual(b)) for a, b in pairwise(widths))
        self.lift = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairwise(widths))
        self.up = nn.ModuleList(_block(a, a) for a in widths[:-1])
        self.head = nn.Conv2d(width, outputs * 4, 1)

    def forward(self, x: Tensor) -> Tensor:
        return F.pixel_shuffle(self.head_at_half(x), 2)

    def head_at_half(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, 4 outputs, H/2, W/2), what pixel shuffle takes."""
        features = [self.stem(F.pixel_unshuffle(x, 2))]
        for down in self.down:
            features.append(down(features[-1]))
        x = features.pop()
        for lift, up in zip(reversed(self.lift), reversed(self.up)):
            x = up(features.pop() + F.interpolate(lift(x), scale_factor=2, mode="nearest"))
        head: Tensor = self.head(x)
        return head


class Guided(nn.Module):
    """`forward(sparse in metres, rgb) -> (out,)`, out (B, 3, H, W): foreground and background in metres, sigma logit.

    Foreground <= background everywhere. H and W must be multiples of 64. Without any sample the depth comes from the
    image alone (a candidate the network draws itself).

    width     features at half resolution
    residual  largest relative correction of a surface (0.05: 5 %)
    tilt      initial exponent of the preference for near or far candidates
    cut       weights below this share of the largest become 0
    """

    def __init__(
        self, width: int = 24, residual: float = 0.03, tilt: float = 0.5, cut: float = 0.02, init: str = "he"
    ) -> None:
        super().__init__()
        self.candidates = candidate_count() + 1  # and one drawn from the image
        if not 0 <= cut < 1:
            raise ValueError(f"cut: expected a share in [0, 1), got {cut}")
        self.residual, self.cut = residual, cut
        self.tilt_bias = tilt - 1 / tilt
        # 2 sets of candidate logits, 2 tilts, 2 residuals, own candidate's log depth, sigma
        self.network = CompactUNet(14, 2 * self.candidates + 6, width)
        initialise(self, init)
        with torch.no_grad():
            self.network.head.weight.mul_(0.01)

    def forward(self, sparse: Tensor, rgb: Tensor) -> tuple[Tensor]:
        require_multiple(sparse, rgb, 64)
        if torch.is_inference_mode_enabled() and sparse.device.type == "cpu":
            return (self._forward_fused(sparse, rgb),)
        found = find_candidates(sparse)
        raw = self.network(torch.cat((rgb, self._depth_features(sparse, found)), 1))
        return (self._assemble(found, raw.float()),)

    def _depth_features(self, sparse: Tensor, found: Candidates) -> Tensor:
        rows = [0, 1, found.count - 2, found.count - 1]  # up, down, second up, second down
        return self._ring_features(sparse, found.log_depth[:, rows], found.prior[:, rows])

    @staticmethod
    def _ring_features(sparse: Tensor, rings: Tensor, prior: Tensor) -> Tensor:
        """(B, 11, H, W): log depths and distances of the rings above and below, the sample itself, the image row.

        rings, prior  (B, 4, H, W) log depth and prior of the ring above, below, second above, second below
        """
        log_depth = rings - LOG_10M
        nearness = torch.exp(prior[:, :2].clamp(min=-6.0))
        missing = (prior[:, :2] < -20).to(sparse.dtype)
        measured = (sparse > 0).to(sparse.dtype)
        gap = log_depth[:, :1] - log_depth[:, 1:2]
        height = torch.linspace(-1, 1, sparse.shape[2], device=sparse.device, dtype=sparse.dtype)
        row = height.view(1, 1, -1, 1).expand_as(sparse)
        return torch.cat((log_depth, nearness, missing, measured, gap, row), 1)

    def _assemble(self, found: Candidates, raw: Tensor) -> Tensor:
        """Candidates (B, K, H, W) and raw outputs (B, 2(K+1)+6, H, W) -> (B, 3, H, W)."""
        near_logits, far_logits, rest = raw.split((self.candidates, self.candidates, 6), 1)
        own = 0.3 + 2.3 * F.softsign(rest[:, 4:5]) + LOG_10M  # 1.4 to 135 m, at first about 13 m
        log_depth = torch.cat((found.log_depth, own), 1)
        prior = torch.cat((found.prior, torch.full_like(own, -5.0)), 1)
        tilt = _squareplus(rest[:, 0:2] + self.tilt_bias)
        inverse = torch.exp(-log_depth)
        near = self._surface(prior + near_logits - tilt[:, 0:1] * log_depth, inverse, rest[:, 2:3])
        far = self._surface(prior + far_logits + tilt[:, 1:2] * log_depth, inverse, rest[:, 3:4])
        return torch.cat((torch.minimum(near, far), torch.maximum(near, far), rest[:, 5:6]), 1)

    def _surface(self, logits: Tensor, inverse: Tensor, correction: Tensor) -> Tensor:
        """(B, 1, H, W) metres: convex combination in inverse depth without small weights, times 1 +- residual."""
        relative = torch.exp(logits - logits.amax(1, keepdim=True))
        weights = F.relu(relative - self.cut)
        mixed = (weights * inverse).sum(1, keepdim=True) / weights.sum(1, keepdim=True)
        return (1 + self.residual * F.softsign(correction)) / mixed

    def _forward_fused(self, sparse: Tensor, rgb: Tensor) -> Tensor:
        """`forward` with everything but the convolutions in two numba passes."""
        from completion.models.guided_cpu import assemble, log_and_prior, rings, shifts_array

        parts = [log_and_prior(*rings(one.numpy())) for one in sparse[:, 0].float()]
        four = [torch.from_numpy(np.stack(part)) for part in zip(*parts)]
        features = self._ring_features(sparse, *four)
        head = self.network.head_at_half(torch.cat((rgb, features), 1).contiguous(memory_format=torch.channels_last))
        heads = head.float().permute(0, 2, 3, 1).contiguous().numpy()
        outputs = [
            assemble(own, *ring, shifts_array(), self.residual, self.cut, self.tilt_bias)
            for own, ring in zip(heads, parts)
        ]
        return torch.from_numpy(np.stack(outputs))
