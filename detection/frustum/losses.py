"""The loss of Frustum PointNet v1 (Qi et al. 2018, section 4.4), with the weights and habits of its published code."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from detection.frustum.coding import BIN, SIZE_TABLE
from detection.frustum.network import VARIANTS, FrustumOutput

# Signs of l, h, w for the eight corners about the geometric centre.
_SIGNS = torch.tensor(
    [[1, 1, 1], [1, 1, -1], [-1, 1, -1], [-1, 1, 1], [1, -1, 1], [1, -1, -1], [-1, -1, -1], [-1, -1, 1]]
)


@dataclass(frozen=True)
class FrustumTargets:
    """Truth of B frustums of N points, rotated to the frustum's centre.

    mask      (B, N) int64, 1 on the object            centre  (B, 3) geometric centre, metres
    bins      (B,) int64 heading bin                   heading (B,) residual of it, radians
    clusters  (B,) int64 size cluster                  size    (B, 3) l w h beyond its mean, metres
    """

    mask: Tensor
    centre: Tensor
    bins: Tensor
    heading: Tensor
    clusters: Tensor
    size: Tensor


def huber(error: Tensor, delta: float) -> Tensor:
    """Mean of e^2 / 2 up to delta, then delta (|e| - delta / 2)."""
    size = error.abs()
    inner = size.clamp(max=delta)
    return (inner * inner / 2 + delta * (size - inner)).mean()


def centred_corners(centre: Tensor, heading: Tensor, size: Tensor) -> Tensor:
    """(B, 8, 3) corners of boxes about their geometric centre (B, 3); heading (B,) radians, size (B, 3) l w h."""
    length, height, width = (size[:, k, None] * _SIGNS.to(size)[:, place] / 2 for place, k in enumerate((0, 2, 1)))
    cos, sin = heading.cos()[:, None], heading.sin()[:, None]
    around = torch.stack([length * cos + width * sin, height, width * cos - length * sin], dim=-1)
    return centre[:, None] + around


def frustum_losses(output: FrustumOutput, target: FrustumTargets, variant: str) -> dict[str, Tensor]:
    """Scalars: every part as it enters the sum, and "loss", their sum.

    segmentation, centre, heading_class, size_class, heading (x 20), size (x 20), first_centre, corners (x 10)
    """
    rows = torch.arange(len(target.bins), device=target.bins.device)
    goal = target.centre if VARIANTS[variant].first_centre_target == "truth" else output.centre
    heading_units = output.heading_units[rows, target.bins]
    means = torch.from_numpy(SIZE_TABLE).to(output.box)[target.clusters]
    size_error = target.size / means - output.size_units[rows, target.clusters]
    parts = {
        "segmentation": F.cross_entropy(output.logits.transpose(1, 2), target.mask),
        "centre": huber(_distance(target.centre, output.centre), 2.0),
        "heading_class": F.cross_entropy(output.heading_scores, target.bins),
        "size_class": F.cross_entropy(output.size_scores, target.clusters),
        "heading": 20 * huber(heading_units - target.heading / (BIN / 2), 1.0),
        "size": 20 * huber(size_error.norm(dim=-1), 1.0),
        "first_centre": huber(_distance(goal, output.first_centre), 1.0),
        "corners": 10 * _corner_loss(output, target, rows, means),
    }
    return {"loss": torch.stack(list(parts.values())).sum(), **parts}


def _distance(first: Tensor, second: Tensor) -> Tensor:
    return (first - second).norm(dim=-1)


def _corner_loss(output: FrustumOutput, target: FrustumTargets, rows: Tensor, means: Tensor) -> Tensor:
    """Distance of corners to the truth, or to the truth turned by pi, whichever is nearer corner by corner."""
    # The published code adds the size residual twice, and its weights were trained so.
    size = means + 2 * output.size_residuals[rows, target.clusters]
    bins = target.bins * BIN
    found = centred_corners(output.centre, bins + output.heading_residuals[rows, target.bins], size)
    heading, true_size = bins + target.heading, means + target.size
    straight = centred_corners(target.centre, heading, true_size)
    turned = centred_corners(target.centre, heading + torch.pi, true_size)
    return huber(torch.minimum(_distance(found, straight), _distance(found, turned)), 1.0)
