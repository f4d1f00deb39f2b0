"""From a box per point to the few regions the second stage looks at (PointRCNN's proposal layer). No gradients."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from detection.ops import nms_axis_aligned, nms_rotated

NEAR_LIMIT, FAR_LIMIT = 40.0, 80.0  # metres along z: bands (0, 40] and (40, 80]
NEAR_SHARE = 0.7


@dataclass(frozen=True)
class ProposalSettings:
    """Budgets of the proposal layer.

    before, after  proposals kept before and after suppression
    iou            suppress above this IoU
    by_distance    70 % of both budgets for z in (0, 40] m and the rest for (40, 80], suppressed separately; otherwise
                   the best scores of the whole frame
    rotated        suppress by the IoU of rotated boxes, else of rectangles that ignore the heading (NMS_TYPE normal)
    """

    before: int
    after: int
    iou: float
    by_distance: bool
    rotated: bool


@dataclass(frozen=True)
class Proposals:
    """rois (B, P, 7) camera form and scores (B, P), padded with zeros; index (B, P) int64 the point of each RoI;
    valid (B, P) False on the padding."""

    rois: Tensor
    scores: Tensor
    index: Tensor
    valid: Tensor


def near_far_budget(total: int) -> tuple[int, int]:
    """A budget split 70 : 30, the near part rounded down: 9000 -> (6300, 2700)."""
    near = int(NEAR_SHARE * total)
    return near, total - near


def select_proposals(boxes: Tensor, scores: Tensor, settings: ProposalSettings) -> Tensor:
    """Indices (int64, at most settings.after) of the proposals of one frame; near ones first when by distance.

    boxes (N, 7) camera form, scores (N,) of any scale.
    """
    suppress = nms_rotated if settings.rotated else nms_axis_aligned
    order = scores.argsort(descending=True, stable=True)
    if not settings.by_distance:
        order = order[: settings.before]
        return order[suppress(boxes[order], scores[order], settings.iou, settings.after)]
    z = boxes[order, 2]
    near = order[(z > 0) & (z <= NEAR_LIMIT)]
    far = order[(z > NEAR_LIMIT) & (z <= FAR_LIMIT)]
    before_near, before_far = near_far_budget(settings.before)
    after_near, after_far = near_far_budget(settings.after)
    if not len(far):
        # The reference fills an empty far band with the next best near proposals.
        far = near[before_near:]
    kept = []
    for band, before, after in ((near, before_near, after_near), (far, before_far, after_far)):
        ranked = band[:before]
        if len(ranked):
            kept.append(ranked[suppress(boxes[ranked], scores[ranked], settings.iou, after)])
    return torch.cat(kept) if kept else order[:0]


@torch.no_grad()
def propose(boxes: Tensor, scores: Tensor, settings: ProposalSettings) -> Proposals:
    """boxes (B, N, 7), scores (B, N) -> Proposals with P = settings.after."""
    batch, size = len(boxes), settings.after
    rois = boxes.new_zeros(batch, size, 7)
    kept_scores = scores.new_zeros(batch, size)
    index = torch.zeros(batch, size, dtype=torch.long, device=boxes.device)
    valid = torch.zeros(batch, size, dtype=torch.bool, device=boxes.device)
    for b in range(batch):
        kept = select_proposals(boxes[b].detach(), scores[b].detach(), settings)
        rois[b, : len(kept)] = boxes[b, kept]
        kept_scores[b, : len(kept)] = scores[b, kept]
        index[b, : len(kept)] = kept
        valid[b, : len(kept)] = True
    return Proposals(rois, kept_scores, index, valid)
