"""A detector for CPUs in the manner of PointRCNN: the `small` presets, trained and shipped with this project.

Same two stages, bin heads, proposals and RoI sampling as PointRCNN (Shi et al. 2019), with what a CPU budget changes:
few points and narrow layers in the first stage, boxes decoded only where a class is likely, and a second stage without
sampling or grouping that looks at *all* points of the cloud inside a proposal and predicts the IoU of its own box.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detection.losses import bin_box_loss, corner_loss, foreground_loss, masked_bce, smooth_l1
from detection.models.batch import PointBatch, RawDetections
from detection.models.box_coding import (
    MEAN_SIZES,
    boxes_from_points,
    decode_residual,
    encode_residual,
    rotate_y,
    rpn_coder,
    to_roi_frame,
)
from detection.models.layers import PointLayer, maximum
from detection.models.pointnet2 import PointNet2Backbone, SetAbstractionSpec
from detection.models.proposals import ProposalSettings, select_proposals
from detection.ops import iou_3d_aligned, roi_pool
from detection.targets import RoiSamplingSettings, point_labels, sample_rois, soft_labels

CLASSES = ("Car", "Pedestrian", "Cyclist")

_LEVELS = (
    SetAbstractionSpec(1024, (0.4, 1.0), (16, 32), ((16, 16, 32), (16, 32, 48))),
    SetAbstractionSpec(256, (1.0, 2.5), (16, 32), ((48, 48, 64), (48, 64, 96))),
    SetAbstractionSpec(64, (2.5, 6.0), (16, 32), ((96, 96, 128), (96, 128, 160))),
)

_PROPOSALS_TRAIN = ProposalSettings(before=1024, after=160, iou=0.8, by_distance=True, rotated=True)
# Every point may propose: with fewer, near cars of a thousand points each leave no room for those of twenty.
_PROPOSALS_TEST = ProposalSettings(before=8192, after=256, iou=0.8, by_distance=True, rotated=True)
_ROIS = RoiSamplingSettings(rois=48, foreground=0.45, background=0.45, easy=0.05, hard_share=0.7)


@dataclass(frozen=True)
class CompactSettings:
    """Everything that shapes a compact detector.

    classes           in the order of the scores
    features          point columns beside x y z, see `detection.inputs.FEATURES`
    levels, propagation  the backbone
    proposals_train, proposals_test  which points' boxes are decoded and survive suppression
    roi_points        points pooled per RoI from the full cloud
    roi_margin        metres added on every side of a RoI before pooling
    roi_widths        widths of the second stage's point networks
    rois              which proposals train the second stage
    iou_range         IoU of the refined box that counts as score 0 and score 1
    point_share       of the first stage's logit added to the second's when detecting
    """

    classes: tuple[str, ...] = CLASSES
    features: tuple[str, ...] = ("height", "range")
    levels: tuple[SetAbstractionSpec, ...] = _LEVELS
    propagation: tuple[tuple[int, ...], ...] = ((64, 64), (96, 96), (160, 128))
    proposals_train: ProposalSettings = _PROPOSALS_TRAIN
    proposals_test: ProposalSettings = _PROPOSALS_TEST
    roi_points: int = 192
    roi_margin: float = 0.5
    roi_widths: tuple[int, int] = (48, 96)
    rois: RoiSamplingSettings = _ROIS
    iou_range: tuple[float, float] = (0.25, 0.85)
    point_share: float = 0.3

    def widened(self, factor: float) -> CompactSettings:
        """The same settings with the widths of the backbone times `factor`, in multiples of 8."""

        def scaled(widths: tuple[int, ...]) -> tuple[int, ...]:
            return tuple(max(8, 8 * round(width * factor / 8)) for width in widths)

        levels = tuple(replace(level, widths=tuple(map(scaled, level.widths))) for level in self.levels)
        return replace(self, levels=levels, propagation=tuple(map(scaled, self.propagation)))


@dataclass(frozen=True)
class PointScores:
    """First stage: features (B, N, C) of all points, logits (B, N, classes)."""

    features: Tensor
    logits: Tensor


@dataclass(frozen=True)
class Regions:
    """Regions of one frame: rois (R, 7), classes (R,) int64 index, features (R, C) of the point that proposed each,
    logits (R,) its class score."""

    rois: Tensor
    classes: Tensor
    features: Tensor
    logits: Tensor


class PointStage(nn.Module):
    """First stage: PointNet++ and two heads; the box head is only asked about likely points."""

    def __init__(self, settings: CompactSettings) -> None:
        super().__init__()
        self.backbone = PointNet2Backbone(len(settings.features), settings.levels, settings.propagation)
        channels = self.backbone.out_channels
        self.coder = rpn_coder()
        self.class_hidden = PointLayer(channels, channels, axes=1)
        self.class_scores = PointLayer(channels, len(settings.classes), axes=1, norm=False, activation=False)
        # No batch normalisation: in training the box head sees foreground points only.
        self.box_hidden = PointLayer(channels, channels, axes=1, norm=False)
        self.box_code = PointLayer(channels, self.coder.channels, axes=1, norm=False, activation=False)
        nn.init.constant_(cast(Tensor, self.class_scores.conv.bias), -math.log(99.0))
        nn.init.normal_(self.box_code.conv.weight, std=0.001)

    def forward(self, points: Tensor) -> PointScores:
        """points (B, N, 3 + E) -> PointScores."""
        features = self.backbone(points)
        return PointScores(features, self.class_scores(self.class_hidden(features)))

    def code(self, features: Tensor) -> Tensor:
        """(R, C) features of chosen points -> (R, 76) box codes."""
        code: Tensor = self.box_code(self.box_hidden(features))
        return code


def _code_order(boxes: Tensor) -> Tensor:
    """Camera form with its bottom centre (R, 7) -> x z y(centre) l w h ry, the order of the residual code."""
    x, y, z, h, w, l, ry = boxes.unbind(-1)
    return torch.stack([x, z, y - h / 2, l, w, h, ry], dim=-1)


def _camera_order(values: Tensor) -> Tensor:
    """Inverse of `_code_order`."""
    x, z, y, l, w, h, ry = values.unbind(-1)
    return torch.stack([x, y + h / 2, z, h, w, l, ry], dim=-1)


def _anchors(rois: Tensor) -> Tensor:
    """RoIs (R, 7) in their own frames, as residual anchors."""
    local = torch.cat([torch.zeros_like(rois[:, :3]), rois[:, 3:6], torch.zeros_like(rois[:, :1])], dim=1)
    return _code_order(local)


def refined_boxes(rois: Tensor, code: Tensor) -> Tensor:
    """(R, 7) RoIs and (R, 7) codes -> (R, 7) boxes in the camera frame."""
    local = _camera_order(decode_residual(code, _anchors(rois)))
    bottom = rois[:, :3] + rotate_y(local[:, :3], rois[:, 6])
    return torch.cat([bottom, local[:, 3:6], (local[:, 6] + rois[:, 6]).unsqueeze(1)], dim=1)


def residual_targets(rois: Tensor, truth: Tensor) -> Tensor:
    """(R, 7) codes that take RoIs to the truth; headings are folded to +-90 degrees (a box is its own turn by pi)."""
    local = to_roi_frame(truth, rois)
    turn = (local[:, 6] + math.pi / 2).remainder(math.pi) - math.pi / 2
    return encode_residual(_code_order(torch.cat([local[:, :6], turn.unsqueeze(1)], dim=1)), _anchors(rois))


class RegionStage(nn.Module):
    """Second stage: two rounds of a point network over a region's points, the second seeing the first's maximum."""

    def __init__(self, settings: CompactSettings, context_channels: int) -> None:
        super().__init__()
        self.classes = len(settings.classes)
        self.margin, self.points = settings.roi_margin, settings.roi_points
        narrow, wide = settings.roi_widths
        point_channels = 3 + 6 + len(settings.features)
        region_channels = context_channels + self.classes + 6
        self.region = PointLayer(region_channels, narrow, axes=1, norm=False)
        self.point_in = nn.Linear(point_channels, narrow)
        self.region_in = nn.Linear(narrow, narrow, bias=False)
        self.point_hidden = nn.Linear(narrow, narrow)
        self.first_out = nn.Linear(narrow, wide)
        self.second_in = nn.Linear(narrow, wide)
        self.maximum_in = nn.Linear(wide, wide, bias=False)
        self.second_out = nn.Linear(wide, wide)
        self.norm = nn.LayerNorm(2 * wide + narrow)
        self.join = nn.Linear(2 * wide + narrow, 128)
        self.score_hidden, self.score = nn.Linear(128, 64), nn.Linear(64, 1)
        self.box_hidden, self.box = nn.Linear(128, 64), nn.Linear(64, 7)
        nn.init.normal_(self.box.weight, std=0.001)
        nn.init.zeros_(self.box.bias)

    def forward(self, cloud: Tensor, regions: Regions) -> tuple[Tensor, Tensor]:
        """cloud (M, 3 + E) of one frame, R regions -> score logits (R,), codes (R, 7)."""
        rois = regions.rois
        pooled, empty = roi_pool(
            cloud[None, :, :3], cloud[None, :, 3:], rois[None], extra_width=self.margin, nsample=self.points
        )
        rows = self._point_rows(pooled[0], rois)
        context = self._context(regions, empty[0])
        hidden = F.relu(self.point_in(rows) + self.region_in(context).unsqueeze(1), inplace=True)
        hidden = F.relu(self.point_hidden(hidden), inplace=True)
        first = F.relu(maximum(self.first_out(hidden)))
        second = F.relu(self.second_in(hidden) + self.maximum_in(first).unsqueeze(1), inplace=True)
        second = F.relu(maximum(self.second_out(second)))
        joined = F.relu(self.join(self.norm(torch.cat([first, second, context], dim=1))))
        score = self.score(F.relu(self.score_hidden(joined))).squeeze(1)
        return score, self.box(F.relu(self.box_hidden(joined)))

    def _point_rows(self, pooled: Tensor, rois: Tensor) -> Tensor:
        """(R, S, 3 + E) pooled points -> (R, S, 3 + 6 + E): RoI frame, distances to the six faces, features."""
        local = rotate_y(pooled[..., :3] - rois[:, None, :3], -rois[:, None, 6])
        x, y, z = local.unbind(-1)
        h, w, l = (rois[:, None, k] for k in (3, 4, 5))
        faces = torch.stack([l / 2 - x, l / 2 + x, w / 2 - z, w / 2 + z, -y, h + y], dim=-1)
        return torch.cat([local, faces, pooled[..., 3:]], dim=-1)

    def _context(self, regions: Regions, empty: Tensor) -> Tensor:
        """(R, narrow) what is known of each region as a whole."""
        rois = regions.rois
        one_hot = F.one_hot(regions.classes, self.classes).to(rois.dtype)
        distance = rois[:, [0, 2]].norm(dim=1, keepdim=True) / 40.0 - 1.0
        known = [
            rois[:, 3:6].clamp(min=0.1).log(),
            distance,
            regions.logits[:, None] / 4.0,
            empty[:, None].to(rois.dtype),
        ]
        context: Tensor = self.region(torch.cat([regions.features, one_hot, *known], dim=1))
        return context


class CompactPointRCNN(nn.Module):
    """Two-stage detector on points for several classes; see the module's text and `CompactSettings`."""

    def __init__(self, settings: CompactSettings) -> None:
        super().__init__()
        self.settings = settings
        self.points = PointStage(settings)
        self.regions = RegionStage(settings, self.points.backbone.out_channels)
        means = torch.tensor([MEAN_SIZES[name] for name in settings.classes], dtype=torch.float32)
        self.register_buffer("mean_sizes", means, persistent=False)
        self.mean_sizes: Tensor

    def propose(self, points: Tensor, scored: PointScores, settings: ProposalSettings) -> list[Regions]:
        """Regions of each frame, without gradients; at least one."""
        with torch.no_grad():
            return [
                self._propose_frame(points[b, :, :3], scored.features[b].detach(), scored.logits[b].detach(), settings)
                for b in range(len(points))
            ]

    def _propose_frame(self, xyz: Tensor, features: Tensor, logits: Tensor, settings: ProposalSettings) -> Regions:
        best, classes = logits.max(dim=1)
        likely = best.topk(min(settings.before, len(best))).indices
        boxes = boxes_from_points(
            xyz[likely],
            self.points.code(features[likely]),
            self.points.coder,
            self.mean_sizes[classes[likely]],
            soft=False,
        )
        boxes = torch.cat([boxes[:, :3], boxes[:, 3:6].clamp(min=0.2), boxes[:, 6:]], dim=1)
        kept = select_proposals(boxes, best[likely], settings)
        if not len(kept):
            kept = torch.zeros(1, dtype=torch.long, device=xyz.device)
        index = likely[kept]
        return Regions(boxes[kept], classes[index], features[index], best[index])

    def training_losses(self, batch: PointBatch, rng: np.random.Generator) -> dict[str, Tensor]:
        """Joint losses of both stages; no gradient passes from the second to the first (as in EPNet)."""
        scored = self.points(batch.points)
        losses = self._point_losses(batch, scored)
        parts = [
            self._region_losses(cloud, regions, boxes, classes, rng)
            for cloud, regions, boxes, classes in zip(
                batch.clouds,
                self.propose(batch.points, scored, self.settings.proposals_train),
                batch.boxes,
                batch.classes,
            )
        ]
        for name in parts[0]:
            losses[name] = torch.stack([part[name] for part in parts]).mean()
        losses["loss"] = torch.stack(list(losses.values())).sum()
        return losses

    def _point_losses(self, batch: PointBatch, scored: PointScores) -> dict[str, Tensor]:
        labels, boxes = [], []
        for points, truth, classes in zip(batch.points, batch.boxes, batch.classes):
            label, box = point_labels(points[:, :3], truth, classes)
            labels.append(label)
            boxes.append(truth[box] if len(truth) else points.new_zeros(len(points), 7))
        label, box, xyz = torch.stack(labels), torch.stack(boxes), batch.points[..., :3]
        chosen = label > 0
        box, means = box[chosen], self.mean_sizes[label[chosen] - 1]
        centre = torch.stack([box[:, 0], box[:, 1] - box[:, 3] / 2, box[:, 2]], dim=1)
        coder = self.points.coder
        targets = coder.encode(centre - xyz[chosen], box[:, 3:6], box[:, 6], means)
        loss = bin_box_loss(self.points.code(scored.features[chosen]), targets, coder)
        return {"point_class": foreground_loss(scored.logits, label), "point_box": loss.total()}

    def _region_losses(
        self, cloud: Tensor, regions: Regions, boxes: Tensor, classes: Tensor, rng: np.random.Generator
    ) -> dict[str, Tensor]:
        chosen = sample_rois(regions.rois, regions.classes + 1, boxes, classes, self.settings.rois, rng)
        source = chosen.source
        regions = Regions(chosen.rois, regions.classes[source], regions.features[source], regions.logits[source])
        score, code = self.regions(cloud, regions)
        matched = chosen.iou > 0
        truth = chosen.truth
        refined = refined_boxes(chosen.rois, code)
        iou = torch.as_tensor(iou_3d_aligned(refined.detach(), truth)).to(score.dtype) * matched
        valid = chosen.iou > 0.9 * self.settings.rois.foreground
        count = valid.sum().clamp(min=1)
        difference = code[valid] - residual_targets(chosen.rois[valid], truth[valid])
        return {
            "region_score": masked_bce(score, soft_labels(iou, *self.settings.iou_range)),
            "region_box": smooth_l1(difference).sum() / count,
            "region_corner": corner_loss(refined[valid], truth[valid]).sum() / count,
        }

    @torch.no_grad()
    def raw_detections(self, batch: PointBatch) -> list[RawDetections]:
        """Refined boxes of each frame with the logit of their predicted quality."""
        scored = self.points(batch.points)
        found = []
        for cloud, regions in zip(batch.clouds, self.propose(batch.points, scored, self.settings.proposals_test)):
            logits, code = self.regions(cloud, regions)
            logits = logits + self.settings.point_share * regions.logits
            found.append(RawDetections(refined_boxes(regions.rois, code), logits, regions.classes))
        return found
