"""What Voxel-RCNN and PV-RCNN share around their second stages: proposals, training RoIs, losses, results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from detection.losses import corner_loss, masked_bce, smooth_l1
from detection.models.batch import PointBatch, RawDetections
from detection.models.lidar_boxes import refined_boxes, residual_targets, to_camera_axes, to_lidar_axes
from detection.models.pointpillars import SingleStage
from detection.models.proposals import Proposals, ProposalSettings, propose
from detection.targets import RoiSamplingSettings, sample_rois, soft_labels

# OpenPCDet: 128 RoIs, half of them foreground (IoU 0.55), background below it, easy below 0.1; no noise.
OPENPCDET_ROIS = RoiSamplingSettings(
    rois=128, foreground=0.55, background=0.55, easy=0.1, hard_share=0.8, noise_tries=0
)


@dataclass(frozen=True)
class TwoStageSettings:
    """Proposals in training and at test time, and which of them are trained on."""

    proposals_train: ProposalSettings
    proposals_test: ProposalSettings
    rois: RoiSamplingSettings = OPENPCDET_ROIS


@dataclass(frozen=True)
class Refinement:
    """Second stage of B frames and P RoIs: cls (B, P, 1) logits, reg (B, P, 7) codes, boxes (B, P, 7) LiDAR form,
    labels (B, P) int64 class index of each RoI."""

    cls: Tensor
    reg: Tensor
    boxes: Tensor
    labels: Tensor


@dataclass(frozen=True)
class TwoStage:
    """first stage, proposals (rois in LiDAR form) and their refinement."""

    first: SingleStage
    proposals: Proposals
    refined: Refinement


@torch.no_grad()
def lidar_proposals(out: SingleStage, settings: ProposalSettings) -> Proposals:
    """The best boxes by their highest class logit after rotated NMS over all classes; rois in LiDAR form."""
    found = propose(to_camera_axes(out.boxes), out.head.cls.max(dim=-1).values, settings)
    rois = out.boxes.gather(1, found.index.unsqueeze(-1).expand(-1, -1, 7)) * found.valid.unsqueeze(-1)
    return Proposals(rois, found.scores, found.index, found.valid)


def refinement(out: SingleStage, proposals: Proposals, cls: Tensor, code: Tensor) -> Refinement:
    """Rows (B * P, 1) and (B * P, 7) of the heads -> Refinement."""
    shape = proposals.rois.shape[:2]
    reg = code.view(*shape, 7)
    labels = out.head.cls.argmax(dim=-1).gather(1, proposals.index)
    return Refinement(cls.view(*shape, 1), reg, refined_boxes(proposals.rois, reg), labels)


@dataclass(frozen=True)
class TrainingRois:
    """rois, truth (B, R, 7) LiDAR form; iou (B, R) of both, 0 where a RoI has no truth."""

    rois: Tensor
    truth: Tensor
    iou: Tensor


@torch.no_grad()
def training_rois(
    out: SingleStage, proposals: Proposals, batch: PointBatch, settings: RoiSamplingSettings, rng: np.random.Generator
) -> TrainingRois:
    """RoIs drawn for every frame; a RoI is matched with the boxes of its own class."""
    labels = out.head.cls.argmax(dim=-1).gather(1, proposals.index) + 1
    rois, truths, ious = [], [], []
    for b, (boxes, classes) in enumerate(zip(batch.boxes, batch.classes)):
        valid = proposals.valid[b]
        candidates = proposals.rois[b, valid]
        chosen = sample_rois(
            to_camera_axes(candidates), labels[b, valid], to_camera_axes(boxes), classes, settings, rng
        )
        rois.append(candidates[chosen.source])
        truths.append(to_lidar_axes(chosen.truth))
        ious.append(chosen.iou)
    return TrainingRois(torch.stack(rois), torch.stack(truths), torch.stack(ious))


def roi_losses(chosen: TrainingRois, foreground: float, logits: Tensor, code: Tensor) -> dict[str, Tensor]:
    """Binary cross entropy against clip(2 IoU - 0.5, 0, 1); box and corner losses over RoIs of IoU > `foreground`.

    logits (B * R, 1), code (B * R, 7)
    """
    iou = chosen.iou.flatten()
    valid = iou > foreground
    rois, truth, code = chosen.rois.flatten(0, 1)[valid], chosen.truth.flatten(0, 1)[valid], code[valid]
    count = valid.sum().clamp(min=1)
    corners = corner_loss(to_camera_axes(refined_boxes(rois, code)), to_camera_axes(truth))
    return {
        "region_score": masked_bce(logits.squeeze(1), soft_labels(iou)),
        "region_box": smooth_l1(code - residual_targets(rois, truth)).sum() / count,
        "region_corner": corners.sum() / count,
    }


def refined_detections(out: TwoStage) -> list[RawDetections]:
    """Refined boxes of each frame with the second stage's logits; padding of the proposals is left out."""
    refined = out.refined
    return [
        RawDetections(refined.boxes[b, valid], refined.cls[b, valid, 0], refined.labels[b, valid])
        for b, valid in enumerate(out.proposals.valid)
    ]


def frame_index(rois: Tensor, points: int) -> Tensor:
    """(B * P * points,) int64: the frame of each grid point of rois (B, P, 7)."""
    frames: Sequence[int] = range(len(rois))
    return torch.tensor(frames, device=rois.device).repeat_interleave(rois.shape[1] * points)
