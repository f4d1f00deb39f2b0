"""PointPillars (Lang et al. 2019) as OpenPCDet trains it on KITTI: pillars, 2D backbone, anchor head."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from detection.models.anchor_head import KITTI_ANCHORS, AnchorClass, AnchorHead, HeadOutput
from detection.models.batch import PointBatch, RawDetections
from detection.models.bev_backbone import BevBackbone, BevSettings
from detection.models.pillars import PillarEncoder
from detection.ops.voxelize import VoxelGrid

MOST_CANDIDATES = 4096  # per frame before the last suppression (OpenPCDet's NMS_PRE_MAXSIZE)

KITTI_PILLARS = VoxelGrid((0, -39.68, -3), (69.12, 39.68, 1), (0.16, 0.16, 4), 32, (16000, 40000))
KITTI_PILLAR_BEV = BevSettings((3, 5, 5), (2, 2, 2), (64, 128, 256), (1, 2, 4), (128, 128, 128))


@dataclass(frozen=True)
class PillarSettings:
    """point_channels count x y z; pillar_channels is the depth of the map."""

    grid: VoxelGrid = KITTI_PILLARS
    point_channels: int = 4
    pillar_channels: int = 64
    bev: BevSettings = KITTI_PILLAR_BEV
    classes: tuple[AnchorClass, ...] = KITTI_ANCHORS


@dataclass(frozen=True)
class SingleStage:
    """spatial_features (B, C, Y, X) before and bev (B, C', Y', X') after the 2D backbone, the head's output, and all
    decoded boxes (B, A, 7) in LiDAR form."""

    spatial_features: Tensor
    bev: Tensor
    head: HeadOutput
    boxes: Tensor


def best_anchors(out: SingleStage) -> list[RawDetections]:
    """Per frame the boxes with the highest class scores, at most 4096."""
    found = []
    for cls, boxes in zip(out.head.cls, out.boxes):
        scores, classes = cls.max(dim=1)
        order = scores.argsort(descending=True, stable=True)[:MOST_CANDIDATES]
        found.append(RawDetections(boxes[order], scores[order], classes[order]))
    return found


def total(losses: dict[str, Tensor]) -> dict[str, Tensor]:
    """The losses and their sum, named "loss"."""
    return {**losses, "loss": torch.stack(list(losses.values())).sum()}


class PointPillars(nn.Module):
    """Pillars, map, 2D backbone, anchors; boxes in LiDAR form."""

    def __init__(self, settings: PillarSettings) -> None:
        super().__init__()
        self.settings = settings
        self.register_buffer("global_step", torch.zeros(1, dtype=torch.long))
        grid, bev = settings.grid, settings.bev
        self.vfe = PillarEncoder(grid, settings.point_channels, settings.pillar_channels)
        self.backbone_2d = BevBackbone(settings.pillar_channels, bev)
        _, height, width = grid.shape
        cells = bev.cells(height), bev.cells(width)
        self.dense_head = AnchorHead(bev.out_channels, settings.classes, grid.low, grid.high, cells)

    def forward(self, clouds: Sequence[Tensor]) -> SingleStage:
        """Clouds of B frames, each (N_i, 3 + E) x y z intensity ... in the LiDAR frame."""
        spatial_features = self.vfe(clouds)
        bev = self.backbone_2d(spatial_features)
        head = self.dense_head(bev)
        return SingleStage(spatial_features, bev, head, self.dense_head.decode(head))

    def training_losses(self, batch: PointBatch, rng: np.random.Generator) -> dict[str, Tensor]:
        """Anchor losses; clouds and boxes (G, 7) of the batch are in the LiDAR frame."""
        out = self(batch.clouds)
        return total(self.dense_head.losses(out.head, batch.boxes, batch.classes))

    @torch.no_grad()
    def raw_detections(self, batch: PointBatch) -> list[RawDetections]:
        """The best anchors of each frame, LiDAR form."""
        return best_anchors(self(batch.clouds))
