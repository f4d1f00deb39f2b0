"""SECOND (Yan et al. 2018) as OpenPCDet trains it on KITTI: sparse 3D backbone, 2D backbone, anchor head."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from detection.models.anchor_head import KITTI_ANCHORS, AnchorClass, AnchorHead
from detection.models.batch import PointBatch, RawDetections
from detection.models.bev_backbone import BevBackbone, BevSettings
from detection.models.pointpillars import SingleStage, best_anchors, total
from detection.models.voxel_backbone import (
    KITTI_WIDTHS,
    VoxelBackbone,
    VoxelLevels,
    Widths,
    bev_channels,
    mean_voxels,
)
from detection.ops.voxelize import VoxelGrid

STRIDE = 8  # voxels per cell of the bird's-eye map

KITTI_VOXELS = VoxelGrid((0, -40, -3), (70.4, 40, 1), (0.05, 0.05, 0.1), 5, (16000, 40000))
KITTI_BEV = BevSettings((5, 5), (1, 2), (128, 256), (1, 2), (256, 256))


@dataclass(frozen=True)
class VoxelSettings:
    """point_channels count x y z; widths are those of the sparse backbone."""

    grid: VoxelGrid = KITTI_VOXELS
    point_channels: int = 4
    widths: Widths = KITTI_WIDTHS
    bev: BevSettings = KITTI_BEV
    classes: tuple[AnchorClass, ...] = KITTI_ANCHORS


class VoxelTrunk(nn.Module):
    """What SECOND is and the two-stage detectors begin with: voxels, sparse 3D backbone, 2D backbone, anchors."""

    def __init__(self, settings: VoxelSettings) -> None:
        super().__init__()
        self.settings = settings
        self.register_buffer("global_step", torch.zeros(1, dtype=torch.long))
        grid, bev = settings.grid, settings.bev
        self.backbone_3d = VoxelBackbone(settings.point_channels, settings.widths)
        self.backbone_2d = BevBackbone(bev_channels(grid, settings.widths), bev)
        _, height, width = grid.shape
        cells = bev.cells(height // STRIDE), bev.cells(width // STRIDE)
        self.dense_head = AnchorHead(bev.out_channels, settings.classes, grid.low, grid.high, cells)

    def first_stage(self, clouds: Sequence[Tensor]) -> tuple[VoxelLevels, SingleStage]:
        """Clouds of B frames, each (N_i, 3 + E) -> levels of the sparse backbone and the anchors' boxes."""
        limit = self.settings.grid.max_voxels[0 if self.training else 1]
        levels = self.backbone_3d(mean_voxels(clouds, self.settings.grid, limit))
        bev = self.backbone_2d(levels.bev)
        head = self.dense_head(bev)
        return levels, SingleStage(levels.bev, bev, head, self.dense_head.decode(head))


class SECOND(VoxelTrunk):
    """One stage on voxels; boxes in LiDAR form."""

    def forward(self, clouds: Sequence[Tensor]) -> SingleStage:
        """Clouds of B frames, each (N_i, 3 + E) x y z intensity ... in the LiDAR frame."""
        return self.first_stage(clouds)[1]

    def training_losses(self, batch: PointBatch, rng: np.random.Generator) -> dict[str, Tensor]:
        """Anchor losses; clouds and boxes (G, 7) of the batch are in the LiDAR frame."""
        out = self(batch.clouds)
        return total(self.dense_head.losses(out.head, batch.boxes, batch.classes))

    @torch.no_grad()
    def raw_detections(self, batch: PointBatch) -> list[RawDetections]:
        """The best anchors of each frame, LiDAR form."""
        return best_anchors(self(batch.clouds))
