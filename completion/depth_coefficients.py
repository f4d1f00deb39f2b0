"""Depth Coefficients: a depth as weights over fixed depth bins (thesis Eq. 2.1, 2.2, 3.4; Imran et al., CVPR 2019).

With bin centres D_j at distance b, a depth d nearest to D_k with delta = (d - D_k) / b in [-0.5, 0.5] becomes
c_{k-1} = (0.5 - delta) / 2, c_k = 0.5, c_{k+1} = (0.5 + delta) / 2, so that sum c = 1 and sum c D = d exactly.
`encode`, `decode` take NumPy arrays (float64-exact) or torch tensors; the bins are the last axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from auglidar_base.errors import SettingsError

# Channels `guard`: one extra bin at either end (the published network's 82 for 80 bins of 1 m).
LAYOUTS = ("guard", "compact")
METHODS = ("linear", "gaussian")
DECODINGS = ("all", "peak")
GAUSSIAN_WIDTH = 0.6  # of a bin; a later port's variant, biased by up to 0.045 b


@dataclass(frozen=True)
class Bins:
    """Uniform depth bins.

    count   bins with a centre at b, 2 b, ..., count b
    size    b in metres
    layout  "guard": one more channel at 0 and one at (count + 1) b, for the outer neighbours; "compact": none, and
            depths within half a bin of the ends are split between the two outermost bins only
    """

    count: int = 80
    size: float = 1.0
    layout: str = "guard"

    def __post_init__(self) -> None:
        if self.layout not in LAYOUTS:
            raise SettingsError(f"layout: expected one of {', '.join(LAYOUTS)}, got {self.layout!r}")
        if self.count < 3 or not self.size > 0:
            raise SettingsError(f"bins: expected at least 3 of positive size, got {self.count} of {self.size} m")

    @property
    def channels(self) -> int:
        """Length of the coefficient vector: count + 2 with guard bins, else count."""
        return self.count + 2 if self.layout == "guard" else self.count

    @property
    def first(self) -> int:
        """Bin number of channel 0."""
        return 0 if self.layout == "guard" else 1

    @property
    def range(self) -> float:
        """Largest bin centre in metres; deeper values are clamped to it before encoding."""
        return self.count * self.size


OUTDOOR = Bins(80, 1.0)
INDOOR = Bins(80, 0.125)


BEYOND = ("clamp", "drop")


def encode(depth: Any, bins: Bins = OUTDOOR, method: str = "linear", beyond: str = "clamp") -> Any:
    """Depth (...), metres, 0 = none -> coefficients (..., channels); dtype of the input, at least float32.

    Depths below half a bin, and invalid ones, give the zero vector.

    method  "linear" (Eq. 2.2, exact) or "gaussian" (three Gaussian weights, normalised; not exact)
    beyond  depths deeper than `bins.range`: "clamp" encodes the range itself (the authors' code); "drop" keeps the
            outer half-bin and gives the zero vector behind it (a later port)
    """
    if beyond not in BEYOND:
        raise ValueError(f"beyond: expected one of {', '.join(BEYOND)}, got {beyond!r}")
    if method not in METHODS:
        raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
    if not isinstance(depth, Tensor):
        kind = np.float64 if np.asarray(depth).dtype == np.float64 else np.float32
        tensor = torch.from_numpy(np.array(depth, kind, order="C"))
        return encode(tensor, bins, method, beyond).numpy()
    channels, weights = sparse_code(depth, bins, method, beyond)
    code = torch.zeros((*depth.shape, bins.channels), dtype=weights.dtype, device=depth.device)
    return code.scatter_add_(-1, channels, weights)


def sparse_code(
    depth: Tensor, bins: Bins = OUTDOOR, method: str = "linear", beyond: str = "clamp"
) -> tuple[Tensor, Tensor]:
    """The three non-zero coefficients: channel indices (..., 3) int64 and weights (..., 3); weights 0 where invalid."""
    scaled = (depth.clamp(max=bins.range) if beyond == "clamp" else depth) / bins.size
    nearest = scaled.round()
    valid = (depth > 0) & (nearest >= 1) & (nearest <= bins.count)
    nearest = nearest.clamp(1, bins.count)
    delta = scaled - nearest
    if method == "gaussian":
        offsets = torch.stack((-1 - delta, -delta, 1 - delta), -1)
        weights = torch.exp(-(offsets**2) / (2 * GAUSSIAN_WIDTH**2))
    else:
        weights = torch.stack(((0.5 - delta) / 2, torch.full_like(delta, 0.5), (0.5 + delta) / 2), -1)
    channels = nearest.long().unsqueeze(-1) + torch.arange(-1, 2, device=depth.device) - bins.first
    if bins.layout == "compact":
        channels, weights = _compact_ends(channels, weights, delta, nearest, bins, method)
    if method == "gaussian":
        weights = weights / weights.sum(-1, keepdim=True)
    return channels, weights * valid.unsqueeze(-1)


def _compact_ends(
    channels: Tensor, weights: Tensor, delta: Tensor, nearest: Tensor, bins: Bins, method: str
) -> tuple[Tensor, Tensor]:
    """Without guard bins: in the outermost bins, weights (1 - |delta|, |delta|) on the bin and its inner neighbour.

    Outward of the outermost centres nothing can represent the depth exactly: it becomes the centre itself.
    """
    inner = torch.where(nearest <= 1, delta.clamp(min=0), (-delta).clamp(min=0))
    zero = torch.zeros_like(inner)
    low, high = (nearest <= 1).unsqueeze(-1), (nearest >= bins.count).unsqueeze(-1)
    if method == "linear":
        weights = torch.where(low, torch.stack((zero, 1 - inner, inner), -1), weights)
        weights = torch.where(high, torch.stack((inner, 1 - inner, zero), -1), weights)
    else:
        outside = (channels < 0) | (channels >= bins.channels)
        weights = weights.masked_fill(outside, 0)
    return channels.clamp(0, bins.channels - 1), weights


def decode(coefficients: Any, bins: Bins = OUTDOOR, which: str = "all", strict_reference: bool = False) -> Any:
    """Coefficients or probabilities (..., channels) -> depth (...) in metres (Eq. 3.4).

    which             "all": sum c D / sum c; "peak": the same over the largest coefficient and its two neighbours
    strict_reference  with "peak": depth 0 where the largest one is a guard bin, as the authors' code gives; otherwise
                      the three bins nearest to it are taken

    0 where the coefficients sum below 1e-5. ValueError for another number of channels or an unknown `which`.
    """
    if which not in DECODINGS:
        raise ValueError(f"which: expected one of {', '.join(DECODINGS)}, got {which!r}")
    if not isinstance(coefficients, Tensor):
        return decode(torch.from_numpy(np.array(coefficients, order="C")), bins, which, strict_reference).numpy()
    if coefficients.shape[-1] != bins.channels:
        raise ValueError(f"expected {bins.channels} coefficients in the last axis, got {tuple(coefficients.shape)}")
    numbers = torch.arange(bins.channels, device=coefficients.device, dtype=coefficients.dtype) + bins.first
    if which == "all":
        return _weighted_mean(coefficients, (numbers * bins.size).expand_as(coefficients))
    # The first maximum on ties; torch's argmax does not promise which.
    is_largest = coefficients == coefficients.amax(-1, keepdim=True)
    peak = torch.where(is_largest, numbers, torch.full_like(numbers, bins.channels)).amin(-1) - bins.first
    around = peak.long().clamp(1, bins.channels - 2).unsqueeze(-1) + torch.arange(-1, 2, device=peak.device)
    depth = _weighted_mean(coefficients.gather(-1, around), (around + bins.first).to(coefficients.dtype) * bins.size)
    if strict_reference:
        guard = (peak == 0) | (peak == bins.channels - 1)
        depth = torch.where(guard, torch.zeros_like(depth), depth)
    return depth


def _weighted_mean(weights: Tensor, values: Tensor) -> Tensor:
    total = weights.sum(-1)
    mean = (weights * values).sum(-1) / total.clamp(min=1e-5)
    return torch.where(total < 1e-5, torch.zeros_like(mean), mean)


def decode_logits(logits: Tensor, bins: Bins = OUTDOOR, which: str = "all") -> Tensor:
    """Network output (B, channels, H, W) -> depth (B, H, W) in metres."""
    return decode(torch.softmax(logits, 1).permute(0, 2, 3, 1), bins, which)


def cross_entropy(logits: Tensor, target: Tensor, weights: Tensor, bins: Bins = OUTDOOR) -> Tensor:
    """Mean of -sum_j c_j log softmax(logits)_j (Eq. 3.3) per image, then over images; nats.

    logits   (B, channels, H, W); target and weights (B, 1, H, W), metres and weight per pixel (0 where no value)

    From three gathered log-probabilities per pixel: the dense target is never made. Its floor is the target's entropy
    (1.0397 at a bin's centre, 0.6931 half-way between two).
    """
    if logits.shape[1] != bins.channels:
        raise ValueError(f"expected {bins.channels} logit channels, got {tuple(logits.shape)}")
    channels, coefficients = sparse_code(target[:, 0], bins)
    log_partition = torch.logsumexp(logits, 1)
    chosen = logits.gather(1, channels.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
    entropy = (coefficients * (log_partition.unsqueeze(-1) - chosen)).sum(-1)
    pixels = weights[:, 0] * (coefficients.sum(-1) > 0).to(weights.dtype)
    return ((entropy * pixels).flatten(1).sum(1) / pixels.flatten(1).sum(1).clamp(min=1e-12)).mean()
