"""The training loss of a network's outputs, for every kind of network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from auglidar_base.errors import SettingsError
from completion import losses
from completion.depth_coefficients import Bins, cross_entropy
from completion.mixture import expected_depth, negative_log_likelihood
from completion.models import ModelSpec

LOSS_KINDS = ("twin", "l1", "l2", "l1_l2", "huber", "dc", "mixture")


@dataclass(frozen=True)
class LossSettings:
    """What is minimised. The defaults are the published TWISE; everything after `target_pooling` is ours.

    kind             "twin", "l1", "l2", "l1_l2", "huber", "dc" (cross-entropy of Depth Coefficients)
                     or "mixture" (likelihood)
    gamma            asymmetry of the twin-surface loss
    detach_surfaces  the fusion term trains sigma alone
    target_pooling   reduction of the target for outputs of lower resolution (`losses.POOLING_RULES`)
    sigma_weight     weight of the auxiliary cross-entropy on sigma at the first and the last step, linear between
    sigma_threshold  metres between the surfaces from which a pixel counts as ambiguous there
    edge_weight      extra weight of pixels at depth edges of the target (0: none; 4: five times)
    relative_weight  share of a pixel's weight that falls with distance beyond 10 m (1: as 10 m / distance)
    above_top_ring   weight of pixels above the topmost measured ring, where nothing can be interpolated (0: no loss)
    max_depth        metres; deeper targets are left out (beyond a LiDAR's range nothing can be learned, yet their
                     errors outweigh the rest); 0: none are, as published
    clamp_depth      metres; deeper targets and predictions count as this deep, predictions below 0 as 0 (NLSPN: 90 on
                     KITTI, 10 on NYU); 0: none do
    auxiliary        weight of further outputs of a "dc" network (published: 0.8)
    """

    RENAMED: ClassVar[Mapping[str, str]] = {"deepest": "max_depth"}

    kind: str = "twin"
    gamma: float = 2.0
    detach_surfaces: bool = False
    target_pooling: str = "average"
    sigma_weight: tuple[float, float] = (0.0, 0.0)
    sigma_threshold: float = 1.0
    edge_weight: float = 0.0
    relative_weight: float = 0.0
    above_top_ring: float = 1.0
    max_depth: float = 0.0
    auxiliary: float = 0.8
    clamp_depth: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in LOSS_KINDS:
            raise SettingsError(f"loss: expected one of {', '.join(LOSS_KINDS)}, got {self.kind!r}")
        if self.gamma < 1:
            raise SettingsError(f"gamma: expected >= 1, got {self.gamma}")
        if self.target_pooling not in losses.POOLING_RULES:
            raise SettingsError(
                f"target_pooling: expected one of {', '.join(losses.POOLING_RULES)}, got {self.target_pooling!r}"
            )


def default_kind(spec: ModelSpec) -> str:
    """What a network with this output is usually trained by."""
    return {"twin": "twin", "coefficients": "dc", "mixture": "mixture", "depth": "l2"}[spec.output]


def fits(loss_settings: LossSettings, spec: ModelSpec) -> None:
    """SettingsError when a network with this output cannot be trained by this loss_settings."""
    needed = {"twin": "twin", "dc": "coefficients", "mixture": "mixture"}.get(loss_settings.kind, "depth")
    # A mixture has an expected depth, so that the same network can be trained by a loss on one depth.
    offered = (spec.output, "depth") if spec.output == "mixture" else (spec.output,)
    if loss_settings.clamp_depth and spec.output != "depth":
        raise SettingsError(
            f"clamp_depth is for networks with output 'depth', {spec.architecture} gives {spec.output!r}"
        )
    if needed not in offered:
        raise SettingsError(
            f"loss {loss_settings.kind!r} needs a network with output {needed!r}, "
            f"{spec.architecture} gives {spec.output!r}"
        )


def pixel_weights(sparse: Tensor, target: Tensor, loss_settings: LossSettings) -> Tensor:
    """Weight of every pixel of the target (B, 1, H, W), metres; 0 where it has no value."""
    weights = losses.valid_weights(target)
    if loss_settings.max_depth:
        weights = weights * (target <= loss_settings.max_depth)
    if loss_settings.above_top_ring != 1:
        below = losses.below_top_ring(sparse)
        weights = weights * (below + loss_settings.above_top_ring * (1 - below))
    if loss_settings.edge_weight:
        weights = weights * (1 + loss_settings.edge_weight * losses.depth_edges(target))
    if loss_settings.relative_weight:
        nearness = (10.0 / target.clamp(min=1e-3)).clamp(max=1.0)
        weights = weights * (1 - loss_settings.relative_weight * (1 - nearness))
    return weights


def training_loss(
    outputs: tuple[Tensor, ...],
    sparse: Tensor,
    target: Tensor,
    spec: ModelSpec,
    loss_settings: LossSettings,
    scale_weights: tuple[float, ...],
    progress: float,
) -> dict[str, Tensor]:
    """Loss parts by name, scalars; "loss" is what is minimised.

    outputs        finest first; sparse and target (B, 1, H, W) in metres
    scale_weights  one per output, as far as given (outputs beyond count 0)
    progress       share of the training done, in [0, 1]
    """
    weights = pixel_weights(sparse, target, loss_settings)
    if loss_settings.clamp_depth:
        target = target.clamp(max=loss_settings.clamp_depth)
        outputs = tuple(output.clamp(0, loss_settings.clamp_depth / spec.depth_unit) for output in outputs)
    if loss_settings.kind == "dc":
        return _coefficient_parts(outputs, target, weights, spec.bins, loss_settings)
    parts: dict[str, Tensor] = {}
    total = torch.zeros((), device=target.device)
    for number, (output, scale_weight) in enumerate(zip(outputs, scale_weights)):
        if scale_weight == 0:
            continue
        factor = target.shape[-1] // output.shape[-1]
        scaled = losses.pool_target(target, factor, loss_settings.target_pooling)
        scale_pixels = losses.pool_target(weights, factor, "maximum") * losses.valid_weights(scaled)
        found = _parts(output.float(), scaled / spec.depth_unit, scale_pixels, spec, loss_settings, progress)
        total = total + scale_weight * found["loss"]
        parts |= found if number == 0 else {f"loss_{number}": found["loss"]}
    return parts | {"loss": total}


def _parts(
    output: Tensor, target: Tensor, weights: Tensor, spec: ModelSpec, loss_settings: LossSettings, progress: float
) -> dict[str, Tensor]:
    """Loss parts of one output; target in the network's unit."""
    if loss_settings.kind == "mixture":
        return {"loss": losses.masked_mean(negative_log_likelihood(output, target), weights)}
    if spec.output == "mixture":
        output = expected_depth(output)
    if loss_settings.kind != "twin":
        return {"loss": losses.DEPTH_LOSSES[loss_settings.kind](output, target, weights)}
    twin = losses.twin_loss(output, target, weights, loss_settings.gamma, loss_settings.detach_surfaces)
    parts = {"foreground": twin.foreground, "background": twin.background, "fusion": twin.fusion}
    total = twin.total
    first, last = loss_settings.sigma_weight
    if first or last:
        parts["sigma"] = losses.sigma_loss(output, target, weights, loss_settings.sigma_threshold / spec.depth_unit)
        # In the unit of the network's loss: the twin terms are metres / depth_unit.
        total = total + (first + (last - first) * progress) / spec.depth_unit * parts["sigma"]
    return parts | {"loss": total}


def _coefficient_parts(
    outputs: tuple[Tensor, ...], target: Tensor, weights: Tensor, bins: Bins, loss_settings: LossSettings
) -> dict[str, Tensor]:
    """Cross-entropy at full resolution, and of further outputs against the target's first valid pixel per block."""
    main = cross_entropy(outputs[0].float(), target, weights, bins)
    parts, total = {"entropy": main}, main
    for number, output in enumerate(outputs[1:], start=1):
        small = losses.pool_target(target, target.shape[-1] // output.shape[-1], "nearest")
        found = cross_entropy(output.float(), small, losses.valid_weights(small), bins)
        parts[f"entropy_{number}"] = found
        total = total + loss_settings.auxiliary * found
    return parts | {"loss": total}
