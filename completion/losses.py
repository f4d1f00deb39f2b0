"""Masked losses of depth completion (thesis sections 3.3, 4.3, 4.4). Depth and error in any one unit.

The cross-entropy of Depth Coefficients is `depth_coefficients.cross_entropy`; the sum over scales is
`training_loss.training_loss`.

Every loss takes maps (B, 1, h, w) and per-pixel weights (0 where the target has no value), averages over the weighted
pixels of each image and then over images; an image without valid pixels counts 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F


def ale(error: Tensor, gamma: float) -> Tensor:
    """Asymmetric linear error max(-e / gamma, gamma e) (Eq. 4.2), e = prediction - target. Overshooting costs gamma."""
    return torch.maximum(-error / gamma, gamma * error)


def rale(error: Tensor, gamma: float) -> Tensor:
    """Reflected asymmetric linear error max(e / gamma, -gamma e) (Eq. 4.3): undershooting costs gamma."""
    return torch.maximum(error / gamma, -gamma * error)


def fusion_error(foreground: Tensor, background: Tensor, sigma: Tensor, target: Tensor) -> Tensor:
    """F(sigma) = |sigma d1 + (1 - sigma) d2 - d_t| (Eq. 4.6), per pixel."""
    return (sigma * foreground + (1 - sigma) * background - target).abs()


def masked_mean(values: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean over each image of (B, 1, h, w), then the mean over images; scalar."""
    total = (values * weights).flatten(1).sum(1)
    return (total / weights.flatten(1).sum(1).clamp(min=1e-12)).mean()


def valid_weights(target: Tensor) -> Tensor:
    """1 where the target has a value (> 0), else 0."""
    return (target > 0).to(target.dtype)


def l1(prediction: Tensor, target: Tensor, weights: Tensor) -> Tensor:
    return masked_mean((prediction - target).abs(), weights)


def l2(prediction: Tensor, target: Tensor, weights: Tensor) -> Tensor:
    return masked_mean((prediction - target).square(), weights)


def l1_l2(prediction: Tensor, target: Tensor, weights: Tensor) -> Tensor:
    """Equal weights, in the unit given (metres by convention)."""
    return l1(prediction, target, weights) + l2(prediction, target, weights)


def huber(prediction: Tensor, target: Tensor, weights: Tensor, delta: float = 1.0) -> Tensor:
    """e^2 / 2 up to `delta`, delta (|e| - delta / 2) beyond."""
    return masked_mean(F.huber_loss(prediction, target, reduction="none", delta=delta), weights)


DEPTH_LOSSES = {"l1": l1, "l2": l2, "l1_l2": l1_l2, "huber": huber}


@dataclass(frozen=True)
class TwinLoss:
    """Parts of the twin-surface loss, scalars; `total` is their sum (Eq. 4.8, F in place of L_e: authors' erratum)."""

    foreground: Tensor
    background: Tensor
    fusion: Tensor

    @property
    def total(self) -> Tensor:
        return self.foreground + self.background + self.fusion


def twin_loss(
    output: Tensor, target: Tensor, weights: Tensor, gamma: float = 2.0, detach_surfaces: bool = False
) -> TwinLoss:
    """ALE on the foreground, RALE on the background, |fused - target| on their mixture.

    output  (B, 3, h, w) raw foreground, background (unit of `target`) and sigma logit: not rectified, so that a surface
            below zero still has a gradient
    gamma   > 1; the foreground's minimum lies on the nearer of two depths if its probability exceeds 1 / (1 + gamma^2)
    detach_surfaces  let the fusion term train sigma alone
    """
    if output.shape[1] != 3:
        raise ValueError(f"twin surface output: expected (B, 3, h, w), got {tuple(output.shape)}")
    foreground, background, logit = output.split(1, 1)
    sigma = torch.sigmoid(logit)
    near, far = (foreground.detach(), background.detach()) if detach_surfaces else (foreground, background)
    return TwinLoss(
        masked_mean(ale(foreground - target, gamma), weights),
        masked_mean(rale(background - target, gamma), weights),
        masked_mean(fusion_error(near, far, sigma, target), weights),
    )


def nearer_surface(foreground: Tensor, background: Tensor, target: Tensor) -> Tensor:
    """1 where the foreground is nearer to the truth than the background, else 0; same shape."""
    return ((foreground - target).abs() < (background - target).abs()).to(target.dtype)


def sigma_loss(output: Tensor, target: Tensor, weights: Tensor, threshold: float) -> Tensor:
    """Cross-entropy of sigma with 'which surface is nearer to the truth', where background - foreground > threshold.

    The fusion loss' gradient on sigma is proportional to background - foreground and vanishes while the two agree; this
    one is not. The surfaces are detached.
    """
    foreground, background, logit = output.split(1, 1)
    near, far = foreground.detach(), background.detach()
    ambiguous = weights * ((far - near) > threshold).to(weights.dtype)
    entropy = F.binary_cross_entropy_with_logits(logit, nearer_surface(near, far, target), reduction="none")
    return masked_mean(entropy, ambiguous)


POOLING_RULES = ("average", "minimum", "maximum", "nearest")


def pool_target(target: Tensor, factor: int, rule: str = "average") -> Tensor:
    """Target (B, 1, H, W), 0 = none -> (B, 1, H/factor, W/factor) over valid pixels, 0 where a block has none.

    rule  "average" (invents depths at edges), "minimum", "maximum", or "nearest" (the block's first valid pixel)
    """
    if rule not in POOLING_RULES:
        raise ValueError(f"pooling rule: expected one of {', '.join(POOLING_RULES)}, got {rule!r}")
    if factor == 1:
        return target
    if rule == "nearest":
        return _first_valid(target, factor)
    if rule == "maximum":
        return F.max_pool2d(target, factor)
    valid = (target > 0).to(target.dtype)
    if rule == "average":
        share = F.avg_pool2d(valid, factor)
        return torch.where(share > 0, F.avg_pool2d(target, factor) / share.clamp(min=1e-12), torch.zeros_like(share))
    far = torch.where(target > 0, -target, torch.full_like(target, -torch.inf))
    pooled = -F.max_pool2d(far, factor)
    return torch.where(torch.isfinite(pooled), pooled, torch.zeros_like(pooled))


def _first_valid(target: Tensor, factor: int) -> Tensor:
    blocks = F.pixel_unshuffle(target, factor)
    first = (blocks > 0).to(torch.uint8).argmax(1, keepdim=True)
    return blocks.gather(1, first)


def depth_edges(target: Tensor, window: int = 5, ratio: float = 1.1, step: float = 1.0) -> Tensor:
    """1 where valid depths within `window` pixels span more than `step` metres and the factor `ratio`; (B, 1, H, W)."""
    half = window // 2
    largest = F.max_pool2d(target, window, stride=1, padding=half)
    negative = torch.where(target > 0, -target, torch.full_like(target, -torch.inf))
    smallest = -F.max_pool2d(negative, window, stride=1, padding=half)
    span = (largest > smallest * ratio) & (largest - smallest > step) & torch.isfinite(smallest)
    return span.to(target.dtype)


def below_top_ring(sparse: Tensor, reach: int = 16) -> Tensor:
    """1 at and below the topmost measured row within `reach` columns, 0 above; all 1 where an image has no sample."""
    measured = F.max_pool2d((sparse > 0).to(sparse.dtype), (1, 2 * reach + 1), stride=1, padding=(0, reach))
    below = measured.cummax(dim=2).values
    empty = (measured.flatten(1).amax(1) == 0).view(-1, 1, 1, 1)
    return torch.where(empty, torch.ones_like(below), below)
