"""What a perfect network would say of a box: the inverse of decoding, for round trips."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from detection.models.box_coding import BinCoder, BinTargets


def perfect_code(coder: BinCoder, targets: BinTargets, confidence: float = 50.0) -> Tensor:
    """(R, channels) code a perfect network would give: `confidence` logits on the target bins, exact residuals."""
    n = coder.location_bins

    def logits(index: Tensor, bins: int) -> Tensor:
        return F.one_hot(index, bins).to(targets.x_res) * confidence

    def residuals(value: Tensor, bins: int) -> Tensor:
        return value[:, None].expand(-1, bins)

    fine = [residuals(targets.x_res, n), residuals(targets.z_res, n)] if coder.fine_location else []
    heading = [logits(targets.ry_bin, coder.heading_bins), residuals(targets.ry_res, coder.heading_bins)]
    blocks = [logits(targets.x_bin, n), logits(targets.z_bin, n), *fine, targets.y_offset[:, None], *heading]
    return torch.cat([*blocks, targets.size_res], dim=-1)
