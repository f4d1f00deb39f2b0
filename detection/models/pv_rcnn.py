"""PV-RCNN (Shi et al. 2020): SECOND, keypoints that carry the scene, and RoI grid pooling from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from detection.losses import foreground_loss
from detection.models.batch import PointBatch, RawDetections
from detection.models.fully_connected import head, hidden_layers
from detection.models.layers import PointwiseWeight
from detection.models.lidar_boxes import roi_grid_points, to_camera_axes
from detection.models.lidar_rois import (
    TwoStage,
    TwoStageSettings,
    lidar_proposals,
    refined_detections,
    refinement,
    roi_losses,
    training_rois,
)
from detection.models.pointpillars import SingleStage, total
from detection.models.second import VoxelSettings, VoxelTrunk
from detection.models.voxel_backbone import bev_channels
from detection.models.voxel_set_abstraction import (
    BallSpec,
    Keypoints,
    KeypointSettings,
    StackedSetAbstraction,
    VoxelSetAbstraction,
)
from detection.targets import point_labels

RING = 0.1  # metres outside a box in which a keypoint is ignored (OpenPCDet: 0.2 m in all along each axis)


KITTI_GRID_BALLS = BallSpec((0.8, 1.6), (16, 16), (64, 64))


@dataclass(frozen=True)
class GridPoolSettings:
    """grid points along each side of a RoI, their balls of keypoints, width of the hidden layers."""

    grid: int = 6
    balls: BallSpec = KITTI_GRID_BALLS
    width: int = 256


class KeypointHead(nn.Module):
    """Whether a keypoint lies in an object."""

    def __init__(self, in_channels: int, width: int) -> None:
        super().__init__()
        self.cls_layers = head(in_channels, (width, width), 1, axes=0, dropout=0.0)

    def forward(self, gathered: Tensor) -> Tensor:
        """(B * K, C) -> logits (B * K, 1)."""
        logits: Tensor = self.cls_layers(gathered)
        return logits


class GridRoIHead(nn.Module):
    """Second stage: grid points of each RoI pool from keypoints, then fully connected layers."""

    def __init__(self, settings: GridPoolSettings, keypoint_channels: int) -> None:
        super().__init__()
        self.settings = settings
        self.roi_grid_pool_layer = StackedSetAbstraction(keypoint_channels, settings.balls)
        width, pooled = settings.width, settings.grid**3 * 2 * settings.balls.widths[-1]
        self.shared_fc_layer = nn.Sequential(*hidden_layers(pooled, (width, width), axes=1, dropout=0.3))
        self.cls_layers = head(width, (width, width), 1, axes=1, dropout=0.3)
        self.reg_layers = head(width, (width, width), 7, axes=1, dropout=0.3)
        last = self.reg_layers[-1]
        assert isinstance(last, PointwiseWeight)
        nn.init.normal_(last.weight, std=0.001)

    def forward(self, found: Keypoints, weight: Tensor, rois: Tensor) -> tuple[Tensor, Tensor]:
        """weight (B * K, 1) of the keypoints, rois (B, P, 7) -> logits (B * P, 1), codes (B * P, 7)."""
        shared = self.shared_fc_layer(self.pool(found, weight, rois).transpose(1, 2).flatten(1))
        return self.cls_layers(shared), self.reg_layers(shared)

    def pool(self, found: Keypoints, weight: Tensor, rois: Tensor) -> Tensor:
        """(B * P, grid^3, C); the layers above take it with channels outermost."""
        places = roi_grid_points(rois.flatten(0, 1), self.settings.grid)
        centres = places.view(len(rois), -1, 3)
        pooled: Tensor = self.roi_grid_pool_layer(list(found.xyz), found.features * weight, centres)
        return pooled.view(*places.shape[:2], -1)


class PVRCNN(VoxelTrunk):
    """Two stages: voxels propose, keypoints refine."""

    def __init__(
        self, first: VoxelSettings, stages: TwoStageSettings, keypoints: KeypointSettings, pool: GridPoolSettings
    ) -> None:
        super().__init__(first)
        self.stages = stages
        self.pfe = VoxelSetAbstraction(
            keypoints, first.grid, first.point_channels, first.widths[1:5], bev_channels(first.grid, first.widths)
        )
        self.point_head = KeypointHead(self.pfe.gathered_channels, pool.width)
        self.roi_head = GridRoIHead(pool, keypoints.channels)

    def forward(self, clouds: Sequence[Tensor]) -> TwoStage:
        """Clouds of B frames, each (N_i, 3 + E) in the LiDAR frame -> both stages, proposals with test settings."""
        out, found, logits = self.scene(clouds)
        proposals = lidar_proposals(out, self.stages.proposals_test)
        return TwoStage(
            out, proposals, refinement(out, proposals, *self.roi_head(found, logits.sigmoid(), proposals.rois))
        )

    def scene(self, clouds: Sequence[Tensor]) -> tuple[SingleStage, Keypoints, Tensor]:
        """First stage, keypoints and their logits (B * K, 1)."""
        inside = [self.settings.grid.crop(cloud) for cloud in clouds]
        levels, out = self.first_stage(inside)
        found = self.pfe(inside, levels)
        return out, found, self.point_head(found.gathered)

    def training_losses(self, batch: PointBatch, rng: np.random.Generator) -> dict[str, Tensor]:
        """Anchor, keypoint and second-stage losses; clouds and boxes (G, 7) of the batch are in the LiDAR frame."""
        out, found, logits = self.scene(batch.clouds)
        losses = self.dense_head.losses(out.head, batch.boxes, batch.classes)
        losses["keypoint_class"] = foreground_loss(logits.squeeze(1)[None], keypoint_labels(found.xyz, batch.boxes))
        proposals = lidar_proposals(out, self.stages.proposals_train)
        chosen = training_rois(out, proposals, batch, self.stages.rois, rng)
        refined = self.roi_head(found, logits.sigmoid(), chosen.rois)
        losses |= roi_losses(chosen, self.stages.rois.foreground, *refined)
        return total(losses)

    @torch.no_grad()
    def raw_detections(self, batch: PointBatch) -> list[RawDetections]:
        """Refined boxes of each frame, LiDAR form."""
        return refined_detections(self(batch.clouds))


@torch.no_grad()
def keypoint_labels(xyz: Tensor, boxes: Sequence[Tensor]) -> Tensor:
    """(1, B * K) int64 labels of keypoints (B, K, 3): 1 in a box (G_i, 7), -1 in the ring round it, else 0."""
    labels = []
    for points, truth in zip(xyz, boxes):
        turned = torch.stack([-points[:, 1], -points[:, 2], points[:, 0]], dim=1)
        ones = torch.ones(len(truth), dtype=torch.long, device=xyz.device)
        labels.append(point_labels(turned, to_camera_axes(truth), ones, RING)[0])
    return torch.cat(labels)[None]
