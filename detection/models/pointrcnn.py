"""PointRCNN (Shi et al. 2019) and its sibling in EPNet without image fusion ("PointRCNN2", Huang et al. 2020)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from auglidar_base.errors import SettingsError
from detection.data_augmentation import augment_regions
from detection.losses import (
    SEGMENTATION_LOSSES,
    aligned_iou,
    bin_box_loss,
    consistency_loss,
    iou_branch_loss,
    masked_bce,
)
from detection.models.batch import PointBatch, RawDetections
from detection.models.box_coding import MEAN_SIZES, boxes_from_points, boxes_from_rois, rotate_y, to_roi_frame
from detection.models.proposals import Proposals, ProposalSettings, propose
from detection.models.rcnn import RCNN
from detection.models.rpn import RPN, RPNOutput
from detection.ops import roi_pool
from detection.targets import RoiSamplingSettings, RoiTargets, classification_labels, point_labels, sample_rois

POOLED_POINTS = 512


@dataclass(frozen=True)
class PointRCNNSettings:
    """What tells the published variants apart (see `detection.models.presets`).

    extra_channels      point channels beside x y z       fine_location  residuals per x and z bin in the first stage
    soft_decoding       expectation over bins (EPNet) instead of the best bin
    consistency_weight  of EPNet's consistency loss, both stages; 0 = none
    mask_threshold      probability from which a point's foreground mask is 1
    pool_margin         metres added on every side of a RoI before pooling
    head_width          of the second stage's heads       iou_branch  EPNet's third head
    roi_augmentation    random scale and mirror of each training RoI (AUG_DATA)
    segmentation_loss   of the points: focal, dice or bce (LOSS_CLS)
    raw_iou             the IoU of the consistency loss takes x and z from the target bins (IOU_LOSS_TYPE raw)
    """

    extra_channels: int
    fine_location: bool
    soft_decoding: bool
    consistency_weight: float
    mask_threshold: float
    pool_margin: float
    head_width: int
    iou_branch: bool
    roi_augmentation: bool
    proposals_train: ProposalSettings
    proposals_test: ProposalSettings
    rois: RoiSamplingSettings
    segmentation_loss: str = "focal"
    raw_iou: bool = False

    def __post_init__(self) -> None:
        if self.segmentation_loss not in SEGMENTATION_LOSSES:
            known = ", ".join(SEGMENTATION_LOSSES)
            raise SettingsError(f"segmentation_loss: expected one of {known}, got {self.segmentation_loss!r}")


@dataclass(frozen=True)
class Refined:
    """Second stage of B frames and P RoIs: cls (B, P, 1) logits (times the IoU branch where there is one),
    reg (B, P, 46), boxes (B, P, 7)."""

    cls: Tensor
    reg: Tensor
    boxes: Tensor


class PointRCNN(nn.Module):
    """Two stages on raw points; one class (Car)."""

    def __init__(self, settings: PointRCNNSettings) -> None:
        super().__init__()
        self.settings = settings
        rare_foreground = settings.segmentation_loss == "focal"
        self.rpn = RPN(settings.extra_channels, settings.fine_location, rare_foreground)
        self.rcnn_net = RCNN(settings.head_width, settings.iou_branch)
        self.register_buffer("mean_size", torch.tensor(MEAN_SIZES["Car"]), persistent=False)
        self.mean_size: Tensor

    def forward(self, points: Tensor) -> tuple[RPNOutput, Proposals, Refined]:
        """points (B, N, 3 + E) -> every point's box, the proposals among them, and their refinement."""
        rpn = self.rpn(points)
        boxes = self.decode_proposals(points, rpn)
        settings = self.settings.proposals_train if self.training else self.settings.proposals_test
        proposals = propose(boxes, rpn.cls.squeeze(-1), settings)
        return rpn, proposals, self.refine(points, rpn, proposals.rois)

    def decode_proposals(self, points: Tensor, rpn: RPNOutput) -> Tensor:
        """(B, N, 7) the box each point proposes, camera form."""
        return boxes_from_points(points[..., :3], rpn.reg, self.rpn.coder, self.mean_size, self.settings.soft_decoding)

    def refine(self, points: Tensor, rpn: RPNOutput, rois: Tensor) -> Refined:
        """points (B, N, 3 + E), first stage, rois (B, P, 7) -> Refined."""
        pooled, _ = self.pool(points, rpn, rois)
        out = self.rcnn_net(canonical(pooled, rois).flatten(0, 1))
        cls = out.cls if out.iou is None else out.cls * out.iou.clamp(min=1e-4)
        reg = out.reg.view(*rois.shape[:2], -1)
        boxes = boxes_from_rois(rois, reg, self.rcnn_net.coder, self.mean_size, self.settings.soft_decoding)
        return Refined(cls.view(*rois.shape[:2], 1), reg, boxes)

    @torch.no_grad()
    def pool(self, points: Tensor, rpn: RPNOutput, rois: Tensor) -> tuple[Tensor, Tensor]:
        """(B, P, 512, 3 + 2 + 128) scene x y z, mask, depth, features of the points in each RoI; (B, P) empty flags.

        depth = |xyz| / 70 m - 0.5. No gradient: the second stage's loss never reaches the first.
        """
        xyz = points[..., :3].contiguous()
        mask = (rpn.cls.sigmoid() > self.settings.mask_threshold).to(xyz.dtype)
        depth = xyz.norm(dim=-1, keepdim=True) / 70.0 - 0.5
        features = torch.cat([mask, depth, rpn.backbone_features.transpose(1, 2)], dim=-1)
        return roi_pool(xyz, features, rois, extra_width=self.settings.pool_margin, nsample=POOLED_POINTS)

    def training_losses(self, batch: PointBatch, rng: np.random.Generator) -> dict[str, Tensor]:
        """Losses of joint training (EPNet's rcnn_online): both stages in one pass, no gradient from second to first."""
        rpn = self.rpn(batch.points)
        losses = self._rpn_losses(batch, rpn)
        boxes = self.decode_proposals(batch.points, rpn)
        proposals = propose(boxes, rpn.cls.squeeze(-1), self.settings.proposals_train)
        losses |= self._rcnn_losses(batch, rpn, self._training_rois(batch, proposals, rng), rng)
        losses["loss"] = torch.stack(list(losses.values())).sum()
        return losses

    def _rpn_losses(self, batch: PointBatch, rpn: RPNOutput) -> dict[str, Tensor]:
        pairs = [point_labels(p[:, :3], b, c) for p, b, c in zip(batch.points, batch.boxes, batch.classes)]
        labels = torch.stack([label for label, _ in pairs])
        chosen = labels > 0
        truth = torch.cat([b[box[label > 0]] for b, (label, box) in zip(batch.boxes, pairs)])
        centres = torch.stack([truth[:, 0], truth[:, 1] - truth[:, 3] / 2, truth[:, 2]], dim=1)
        coder, code = self.rpn.coder, rpn.reg[chosen]
        targets = coder.encode(centres - batch.points[..., :3][chosen], truth[:, 3:6], truth[:, 6], self.mean_size)
        loss = bin_box_loss(code, targets, coder)
        segmentation = SEGMENTATION_LOSSES[self.settings.segmentation_loss]
        losses = {"rpn_cls": segmentation(rpn.cls, labels), "rpn_reg": loss.total()}
        if self.settings.consistency_weight:
            logits = rpn.cls.squeeze(-1)[chosen]
            raw = self.settings.raw_iou
            agreement = consistency_loss(logits, code, targets, truth[:, 3:6], self.mean_size, coder, raw)
            losses["rpn_consistency"] = self.settings.consistency_weight * agreement
        return losses

    def _training_rois(self, batch: PointBatch, proposals: Proposals, rng: np.random.Generator) -> list[RoiTargets]:
        chosen = []
        for rois, valid, boxes, classes in zip(proposals.rois, proposals.valid, batch.boxes, batch.classes):
            candidates = rois[valid] if bool(valid.any()) else boxes
            one_class = torch.ones(len(candidates), dtype=torch.long, device=boxes.device)
            chosen.append(sample_rois(candidates, one_class, boxes, classes, self.settings.rois, rng))
        return chosen

    def _rcnn_losses(
        self, batch: PointBatch, rpn: RPNOutput, chosen: list[RoiTargets], rng: np.random.Generator
    ) -> dict[str, Tensor]:
        rois, truth = torch.stack([frame.rois for frame in chosen]), torch.stack([frame.truth for frame in chosen])
        iou = torch.stack([frame.iou for frame in chosen]).flatten()
        pooled, empty = self.pool(batch.points, rpn, rois)
        if self.settings.roi_augmentation:
            pooled, rois, truth = augment_regions(pooled, rois, truth, rng)
        out = self.rcnn_net(canonical(pooled, rois).flatten(0, 1))
        valid = (iou > self.settings.rois.foreground) & ~empty.flatten()
        local = to_roi_frame(truth, rois).flatten(0, 1)[valid]
        coder, code, logits = self.rcnn_net.coder, out.reg[valid], out.cls.squeeze(1)
        targets = coder.encode(local[:, :3], local[:, 3:6], local[:, 6], self.mean_size)
        losses = {
            "rcnn_cls": masked_bce(logits, classification_labels(iou, empty.flatten())),
            "rcnn_reg": bin_box_loss(code, targets, coder).total(),
        }
        raw = self.settings.raw_iou
        if self.settings.consistency_weight:
            agreement = consistency_loss(logits[valid], code, targets, local[:, 3:6], self.mean_size, coder, raw)
            losses["rcnn_consistency"] = self.settings.consistency_weight * agreement
        if out.iou is not None:
            overlap = aligned_iou(code, targets, local[:, 3:6], self.mean_size, coder, raw)
            losses["rcnn_iou"] = iou_branch_loss(out.iou.squeeze(1)[valid], overlap)
        return losses

    @torch.no_grad()
    def raw_detections(self, batch: PointBatch) -> list[RawDetections]:
        """Refined boxes of each frame; padding of the proposals is left out."""
        _, proposals, refined = self(batch.points)
        found = []
        for boxes, logits, valid in zip(refined.boxes, refined.cls.squeeze(-1), proposals.valid):
            zeros = torch.zeros(int(valid.sum()), dtype=torch.long, device=boxes.device)
            found.append(RawDetections(boxes[valid], logits[valid], zeros))
        return found


def canonical(pooled: Tensor, rois: Tensor) -> Tensor:
    """(B, P, S, 3 + C) pooled points, x y z moved into the frame of their RoI (B, P, 7): bottom centre, heading +x."""
    local = rotate_y(pooled[..., :3] - rois[:, :, None, :3], -rois[:, :, None, 6])
    return torch.cat([local, pooled[..., 3:]], dim=-1)
