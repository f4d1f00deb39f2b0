"""A pixel's depth as a mixture of Laplace distributions in log depth: likelihood, quantiles and twin surfaces.

Tensor `mixture` (B, 2K + 1, H, W): K logits, K natural logs of depth in metres, one log scale shared by the K parts.

Why quantiles are twin surfaces: the expected asymmetric loss ALE with gamma is smallest at the 1 / (1 + gamma^2)
quantile of the depth, RALE at gamma^2 / (1 + gamma^2) (thesis Eq. 4.2, 4.3; for two surfaces this is the rule
gamma > sqrt(p2 / p1) of Eq. 4.6). A network that knows the distribution therefore knows both surfaces for every gamma.
"""

from __future__ import annotations

import torch
from torch import Tensor

SMALLEST_SCALE, LARGEST_SCALE = 0.01, 0.5


def split_mixture(mixture: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(B, 2K + 1, H, W) -> logits (B, K, H, W), log depths (B, K, H, W), relative scale (B, 1, H, W) in 0.01..0.51."""
    parts = (mixture.shape[1] - 1) // 2
    logits, log_depths, raw_scale = mixture.split((parts, parts, 1), 1)
    # Starts near 0.02: two per cent of the depth.
    return logits, log_depths, SMALLEST_SCALE + LARGEST_SCALE * torch.sigmoid(raw_scale - 4)


def negative_log_likelihood(mixture: Tensor, target: Tensor) -> Tensor:
    """(B, 1, H, W): -log density of ln(target) at every pixel, for target (B, 1, H, W) in metres > 0."""
    logits, log_depths, scale = split_mixture(mixture)
    distance = (log_depths - torch.log(target.clamp(min=0.1))).abs()
    parts = torch.log_softmax(logits, 1) - distance / scale - torch.log(2 * scale)
    return -torch.logsumexp(parts, 1, keepdim=True)


def expected_depth(mixture: Tensor) -> Tensor:
    """(B, 1, H, W) metres: the mean of the candidates, what a squared loss would give (and smears)."""
    logits, log_depths, _ = split_mixture(mixture)
    return (torch.softmax(logits, 1) * torch.exp(log_depths)).sum(1, keepdim=True)


def quantiles(mixture: Tensor, shares: tuple[float, ...]) -> list[Tensor]:
    """Each (B, 1, H, W) metres: the candidate at which the cumulated weight reaches the share. 0.5 is the median."""
    return [torch.exp(log_depth) for log_depth in _log_quantiles(mixture, shares)]


def _log_quantiles(mixture: Tensor, shares: tuple[float, ...]) -> list[Tensor]:
    logits, log_depths, _ = split_mixture(mixture)
    ordered, order = log_depths.sort(1)
    cumulated = torch.softmax(logits, 1).gather(1, order).cumsum(1)
    last = ordered.shape[1] - 1
    return [ordered.gather(1, (cumulated < share).sum(1, keepdim=True).clamp(max=last)) for share in shares]


def surface_shares(gamma: float) -> tuple[float, float]:
    """The shares of the foreground's and the background's quantile: 1 / (1 + gamma^2) and gamma^2 / (1 + gamma^2)."""
    low = 1 / (1 + gamma**2)
    return low, 1 - low


def twin_surfaces(mixture: Tensor, gamma: float = 2.0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Foreground, background, sigma, median, each (B, 1, H, W): metres, metres, [0, 1], metres.

    sigma is the probability that the depth lies nearer to the foreground than to the background (in log depth).
    """
    low, high = surface_shares(gamma)
    foreground, median, background = _log_quantiles(mixture, (low, 0.5, high))
    logits, log_depths, _ = split_mixture(mixture)
    # In log depth, not from metres: where both surfaces are one candidate, rounding must not leave it out.
    nearer = log_depths <= 0.5 * (foreground + background)
    sigma = (torch.softmax(logits, 1) * nearer).sum(1, keepdim=True).clamp(0, 1)
    return torch.exp(foreground), torch.exp(background), sigma, torch.exp(median)
