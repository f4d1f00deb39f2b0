"""Single-shot head on a bird's-eye map: anchors, their targets and losses (SECOND, Yan et al. 2018; OpenPCDet)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detection.losses import sigmoid_focal, smooth_l1
from detection.models.box_coding import decode_residual, encode_residual
from detection.models.lidar_boxes import limit_period, nearest_bev_iou

ROTATIONS = (0.0, 1.57)
DIRECTION_OFFSET = 0.78539  # OpenPCDet's DIR_OFFSET: the border between the two directions, radians


@dataclass(frozen=True)
class AnchorClass:
    """Anchors of a class: l w h and height of the bottom (LiDAR frame) in metres; IoU of positives and negatives."""

    name: str
    size: tuple[float, float, float]
    bottom: float
    matched: float
    unmatched: float


CAR = AnchorClass("Car", (3.9, 1.6, 1.56), -1.78, 0.6, 0.45)
PEDESTRIAN = AnchorClass("Pedestrian", (0.8, 0.6, 1.73), -0.6, 0.5, 0.35)
CYCLIST = AnchorClass("Cyclist", (1.76, 0.6, 1.73), -0.6, 0.5, 0.35)
KITTI_ANCHORS = (CAR, PEDESTRIAN, CYCLIST)


def make_anchors(
    classes: Sequence[AnchorClass], low: Sequence[float], high: Sequence[float], cells: tuple[int, int]
) -> Tensor:
    """(Y * X * classes * 2, 7) anchors; per cell class by class, then rotation.

    low, high  x y of the range in metres: the first and last centres lie on its borders     cells  (Y, X) of the map
    """
    y, x = (
        torch.linspace(start, end, count, dtype=torch.float64)
        for start, end, count in ((low[1], high[1], cells[0]), (low[0], high[0], cells[1]))
    )
    kinds = torch.tensor(
        [[c.bottom + c.size[2] / 2, *c.size, rotation] for c in classes for rotation in ROTATIONS], dtype=torch.float64
    )
    grid = torch.stack(torch.meshgrid(y, x, indexing="ij"), dim=-1).flip(-1)
    places = grid[:, :, None].expand(-1, -1, len(kinds), -1)
    return torch.cat([places, kinds.expand(*cells, -1, -1)], dim=-1).reshape(-1, 7).float()


@dataclass(frozen=True)
class HeadOutput:
    """cls (B, A, classes) logits, box (B, A, 7) codes, direction (B, A, 2) logits of all anchors."""

    cls: Tensor
    box: Tensor
    direction: Tensor


@dataclass(frozen=True)
class AnchorTargets:
    """labels (A,) int64: class from 1, 0 background, -1 ignored; boxes (A, 7) the truth where labels > 0."""

    labels: Tensor
    boxes: Tensor


def match_anchors(anchors: Tensor, truth: Tensor, label: int, matched: float, unmatched: float) -> AnchorTargets:
    """Targets of one class's anchors (A, 7) from its boxes (G, 7).

    Positive at `matched` IoU and above, background below `unmatched`; the best anchors of every box (all ties, IoU > 0)
    are positive whatever their IoU. A positive learns the box it overlaps most.
    """
    labels = torch.zeros(len(anchors), dtype=torch.long, device=anchors.device)
    if not len(truth):
        return AnchorTargets(labels, torch.zeros_like(anchors))
    overlap = nearest_bev_iou(anchors, truth)
    best, box = overlap.max(dim=1)
    best_of_box = overlap.max(dim=0).values
    forced = ((overlap == best_of_box) & (best_of_box > 0)).any(dim=1)
    labels[best >= unmatched] = -1
    labels[(best >= matched) | forced] = label
    return AnchorTargets(labels, truth[box])


class AnchorHead(nn.Module):
    """1x1 convolutions on the map; the anchors they refer to."""

    def __init__(
        self,
        in_channels: int,
        classes: tuple[AnchorClass, ...],
        low: Sequence[float],
        high: Sequence[float],
        cells: tuple[int, int],
    ) -> None:
        super().__init__()
        self.classes = classes
        per_cell = len(classes) * len(ROTATIONS)
        self.conv_cls = nn.Conv2d(in_channels, per_cell * len(classes), 1)
        self.conv_box = nn.Conv2d(in_channels, per_cell * 7, 1)
        self.conv_dir_cls = nn.Conv2d(in_channels, per_cell * 2, 1)
        nn.init.constant_(cast(Tensor, self.conv_cls.bias), -math.log(99.0))
        nn.init.normal_(self.conv_box.weight, std=0.001)
        self.register_buffer("anchors", make_anchors(classes, low, high, cells), persistent=False)
        self.anchors: Tensor

    def forward(self, bev: Tensor) -> HeadOutput:
        """(B, C, Y, X) -> HeadOutput; anchors run over y, x, then within the cell."""

        def rows(conv: nn.Conv2d, width: int) -> Tensor:
            return cast(Tensor, conv(bev)).permute(0, 2, 3, 1).reshape(len(bev), -1, width)

        out = HeadOutput(rows(self.conv_cls, len(self.classes)), rows(self.conv_box, 7), rows(self.conv_dir_cls, 2))
        if out.box.shape[1] != len(self.anchors):
            raise ValueError(
                f"anchor head: expected a map for {len(self.anchors)} anchors, got {tuple(bev.shape)}, "
                f"which has {out.box.shape[1]}"
            )
        return out

    def decode(self, out: HeadOutput) -> Tensor:
        """(B, A, 7) boxes; the residual heading counts modulo pi, the direction adds half a turn."""
        boxes = decode_residual(out.box, self.anchors)
        direction = out.direction.argmax(dim=-1)
        heading = limit_period(boxes[..., 6] - DIRECTION_OFFSET, 0.0, math.pi) + DIRECTION_OFFSET
        return torch.cat([boxes[..., :6], (heading + math.pi * direction).unsqueeze(-1)], dim=-1)

    @torch.no_grad()
    def targets(self, truth: Tensor, labels: Tensor) -> AnchorTargets:
        """Targets of all anchors from boxes (G, 7) with labels (G,) from 1; anchors see boxes of their class only."""
        by_class = self.anchors.view(-1, len(self.classes), len(ROTATIONS), 7)
        found = []
        for k, kind in enumerate(self.classes):
            own = by_class[:, k].reshape(-1, 7)
            found.append(match_anchors(own, truth[labels == k + 1], k + 1, kind.matched, kind.unmatched))
        all_labels = torch.stack([item.labels.view(-1, len(ROTATIONS)) for item in found], dim=1)
        boxes = torch.stack([item.boxes.view(-1, len(ROTATIONS), 7) for item in found], dim=1)
        return AnchorTargets(all_labels.reshape(-1), boxes.reshape(-1, 7))

    def losses(self, out: HeadOutput, truth: Sequence[Tensor], labels: Sequence[Tensor]) -> dict[str, Tensor]:
        """Focal classification, box and direction losses; each frame over its positives, then the mean over frames."""
        frames = [
            self._frame_losses(out.cls[b], out.box[b], out.direction[b], self.targets(truth[b], labels[b]))
            for b in range(len(out.cls))
        ]
        return {name: torch.stack([frame[name] for frame in frames]).mean() for name in frames[0]}

    def _frame_losses(self, cls: Tensor, box: Tensor, direction: Tensor, targets: AnchorTargets) -> dict[str, Tensor]:
        """Weights 1 (class), 2 (box), 0.2 (direction)."""
        positive, cared = targets.labels > 0, targets.labels >= 0
        count = positive.sum().clamp(min=1)
        wanted = F.one_hot(targets.labels.clamp(min=0), len(self.classes) + 1)[:, 1:].to(cls.dtype)
        focal = (sigmoid_focal(cls, wanted) * cared[:, None]).sum() / count
        anchors, boxes, code = self.anchors[positive], targets.boxes[positive], box[positive]
        goal = encode_residual(boxes, anchors)
        # A heading and its opposite cost the same; the direction tells them apart.
        turn = (code[:, 6] - goal[:, 6]).sin()
        difference = torch.cat([code[:, :6] - goal[:, :6], turn[:, None]], dim=1)
        side = limit_period(boxes[:, 6] - DIRECTION_OFFSET, 0.0, 2 * math.pi)
        side = (side / math.pi).floor().long().clamp(0, 1)
        facing = F.cross_entropy(direction[positive], side, reduction="sum")
        return {
            "anchor_class": focal,
            "anchor_box": 2.0 * smooth_l1(difference).sum() / count,
            "anchor_direction": 0.2 * facing / count,
        }
