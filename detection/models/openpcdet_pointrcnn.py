"""OpenPCDet's PointRCNN: three classes, residual box codes, LiDAR frame; with the parameter names of its checkpoints.

For inference with imported weights. Boxes are x y z (geometric centre) l w h heading in the LiDAR frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detection.models.batch import PointBatch, RawDetections
from detection.models.box_coding import decode_point_residual, decode_residual
from detection.models.layers import IndexedMLP, PointwiseWeight, RowBatchNorm, project
from detection.models.pointnet2 import GroupAll, PointNet2Backbone, SetAbstraction, SetAbstractionSpec
from detection.models.proposals import Proposals, ProposalSettings, propose
from detection.ops import roi_pool

CLASSES = ("Car", "Pedestrian", "Cyclist")
MEAN_SIZES = ((3.9, 1.6, 1.56), (0.8, 0.6, 1.73), (1.76, 0.6, 1.73))  # l w h
POOLED_POINTS = 512
PROPOSALS = ProposalSettings(before=9000, after=100, iou=0.85, by_distance=False, rotated=True)


def to_camera_axes(boxes: Tensor) -> Tensor:
    """LiDAR-form boxes (..., 7) -> camera form in axes turned to x right, y down, z forward; the origin stays."""
    x, y, z, l, w, h, heading = boxes.unbind(-1)
    return torch.stack([-y, h / 2 - z, x, h, w, l, -heading - torch.pi / 2], dim=-1)


def rotate_z(points: Tensor, angle: Tensor) -> Tensor:
    """(..., 3) points turned counter-clockwise about z by (...) radians."""
    cos, sin = angle.cos(), angle.sin()
    x, y, z = points.unbind(-1)
    return torch.stack([x * cos - y * sin, x * sin + y * cos, z], dim=-1)


@dataclass(frozen=True)
class PointHeadOutput:
    """backbone_features (B, 128, N), cls (B, N, 3) logits, box (B, N, 8) codes."""

    backbone_features: Tensor
    cls: Tensor
    box: Tensor


@dataclass(frozen=True)
class RefinedLidar:
    """cls (B, P, 1) logits, reg (B, P, 7) codes, boxes (B, P, 7) LiDAR form, labels (B, P) int64 class index."""

    cls: Tensor
    reg: Tensor
    boxes: Tensor
    labels: Tensor


def _dense_head(in_channels: int, hidden: int, out_channels: int, axes: int, dropout: bool) -> nn.Sequential:
    """Two hidden layers with normalisation, then a biased layer; a Dropout at index 3 where the checkpoint has one."""
    modules: list[nn.Module] = []
    for channels in (in_channels, hidden):
        modules += [PointwiseWeight(channels, hidden, axes, bias=False), RowBatchNorm(hidden), nn.ReLU()]
    modules.append(PointwiseWeight(hidden, out_channels, axes, bias=True))
    if dropout:
        modules.insert(3, nn.Dropout(0.0))
    return nn.Sequential(*modules)


def _run(head: nn.Sequential, rows: Tensor) -> Tensor:
    """The layers of a `_dense_head`, normalisations folded into the products."""
    convolutions = [module for module in head if isinstance(module, PointwiseWeight)]
    norms = [module for module in head if isinstance(module, RowBatchNorm)]
    for conv, norm in zip(convolutions, norms):
        rows = F.relu(project(conv, norm, rows), inplace=True)
    return cast(Tensor, convolutions[-1](rows))


class PointHead(nn.Module):
    """First stage's heads on the features of every point."""

    def __init__(self) -> None:
        super().__init__()
        self.cls_layers = _dense_head(128, 256, len(CLASSES), axes=0, dropout=False)
        self.box_layers = _dense_head(128, 256, 8, axes=0, dropout=False)


class RoIHead(nn.Module):
    """Second stage; its set abstractions are normalised although the configuration says USE_BN False."""

    def __init__(self) -> None:
        super().__init__()
        first = SetAbstractionSpec(128, (0.2,), (16,), ((128, 128, 128),))
        second = SetAbstractionSpec(32, (0.4,), (16,), ((128, 128, 256),))
        self.SA_modules = nn.ModuleList(
            [
                SetAbstraction(128, first, mlp=IndexedMLP),
                SetAbstraction(128, second, mlp=IndexedMLP),
                GroupAll(256, (256, 256, 512), mlp=IndexedMLP),
            ]
        )
        self.xyz_up_layer = IndexedMLP((5, 128, 128), norm=False)
        self.merge_down_layer = IndexedMLP((256, 128), norm=False)
        self.cls_layers = _dense_head(512, 256, 1, axes=1, dropout=True)
        self.reg_layers = _dense_head(512, 256, 7, axes=1, dropout=True)

    def forward(self, pooled: Tensor) -> tuple[Tensor, Tensor]:
        """pooled (R, 512, 5 + 128): x y z in the RoI's frame, score, depth, features -> logits (R, 1), codes (R, 7)."""
        xyz = pooled[..., :3].contiguous()
        features = self.merge_down_layer(torch.cat([self.xyz_up_layer(pooled[..., :5]), pooled[..., 5:]], dim=-1))
        for level in list(self.SA_modules)[:2]:
            xyz, features = level(xyz, features)
        described = self.SA_modules[2](xyz, features)
        return _run(self.cls_layers, described), _run(self.reg_layers, described)


class OpenPCDetPointRCNN(nn.Module):
    """PointRCNN as OpenPCDet trains it (pointrcnn.yaml): x y z intensity (raw reflectance) in, LiDAR frame."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("global_step", torch.zeros(1, dtype=torch.long))
        self.backbone_3d = PointNet2Backbone(1, mlp=IndexedMLP)
        self.point_head = PointHead()
        self.roi_head = RoIHead()
        self.register_buffer("mean_sizes", torch.tensor(MEAN_SIZES), persistent=False)
        self.mean_sizes: Tensor

    def forward(self, points: Tensor) -> tuple[PointHeadOutput, Proposals, RefinedLidar]:
        """points (B, N, 4) x y z intensity, LiDAR frame, shuffled -> heads, proposals (LiDAR form), refinement."""
        heads = self.point_heads(points)
        proposals = self.propose(self.decode_proposals(points, heads), heads)
        return heads, proposals, self.refine(points, heads, proposals)

    def point_heads(self, points: Tensor) -> PointHeadOutput:
        """(B, N, 4) -> PointHeadOutput in the order of the points."""
        features = self.backbone_3d(points)
        cls, box = _run(self.point_head.cls_layers, features), _run(self.point_head.box_layers, features)
        return PointHeadOutput(features.transpose(1, 2), cls, box)

    def decode_proposals(self, points: Tensor, heads: PointHeadOutput) -> Tensor:
        """(B, N, 7) LiDAR-form box of every point, with the mean size of its best class."""
        return decode_point_residual(points[..., :3], heads.box, self.mean_sizes[heads.cls.argmax(dim=-1)])

    def propose(self, boxes: Tensor, heads: PointHeadOutput) -> Proposals:
        """Class-agnostic proposals by the best class logit; rois are in LiDAR form."""
        found = propose(to_camera_axes(boxes), heads.cls.max(dim=-1).values, PROPOSALS)
        rois = boxes.gather(1, found.index.unsqueeze(-1).expand(-1, -1, 7)) * found.valid.unsqueeze(-1)
        return Proposals(rois, found.scores, found.index, found.valid)

    def refine(self, points: Tensor, heads: PointHeadOutput, proposals: Proposals) -> RefinedLidar:
        """Second stage for proposals with LiDAR-form rois (B, P, 7)."""
        rois = proposals.rois
        logits, code = self.roi_head(self._pooled(points, heads, rois).flatten(0, 1))
        code = code.view(*rois.shape[:2], 7)
        anchors = torch.cat([torch.zeros_like(rois[..., :3]), rois[..., 3:]], dim=-1)
        local = decode_residual(code, anchors)
        centre = rotate_z(local[..., :3], rois[..., 6]) + rois[..., :3]
        labels = heads.cls.argmax(dim=-1).gather(1, proposals.index)
        return RefinedLidar(logits.view(*rois.shape[:2], 1), code, torch.cat([centre, local[..., 3:]], dim=-1), labels)

    def _pooled(self, points: Tensor, heads: PointHeadOutput, rois: Tensor) -> Tensor:
        """(B, P, 512, 3 + 2 + 128) points of each RoI in its frame; zeros where a RoI holds none."""
        xyz = points[..., :3]
        score = heads.cls.max(dim=-1, keepdim=True).values.sigmoid()
        depth = xyz.norm(dim=-1, keepdim=True) / 70.0 - 0.5
        features = torch.cat([xyz, score, depth, heads.backbone_features.transpose(1, 2)], dim=-1)
        turned = torch.stack([-points[..., 1], -points[..., 2], points[..., 0]], dim=-1)
        pooled, empty = roi_pool(turned, features, to_camera_axes(rois), extra_width=0.0, nsample=POOLED_POINTS)
        local = rotate_z(pooled[..., 3:6] - rois[:, :, None, :3], -rois[:, :, None, 6])
        filled = torch.cat([local, pooled[..., 6:]], dim=-1)
        return filled * (~empty)[:, :, None, None]

    @torch.no_grad()
    def raw_detections(self, batch: PointBatch) -> list[RawDetections]:
        """Refined LiDAR-form boxes of each frame; padding of the proposals is left out."""
        _, proposals, refined = self(batch.points)
        return [
            RawDetections(refined.boxes[b, valid], refined.cls[b, valid, 0], refined.labels[b, valid])
            for b, valid in enumerate(proposals.valid)
        ]
