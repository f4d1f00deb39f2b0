"""Voxel-RCNN (Deng et al. 2021): SECOND with a second stage that pools voxels round a grid in each proposal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detection.models.batch import PointBatch, RawDetections
from detection.models.fully_connected import hidden_layers
from detection.models.layers import PointwiseWeight, RowBatchNorm, maximum
from detection.models.lidar_boxes import roi_grid_points
from detection.models.lidar_rois import (
    TwoStage,
    TwoStageSettings,
    frame_index,
    lidar_proposals,
    refined_detections,
    refinement,
    roi_losses,
    training_rois,
)
from detection.models.pointpillars import total
from detection.models.second import VoxelSettings, VoxelTrunk
from detection.models.voxel_backbone import SparseTensor, VoxelLevels
from detection.ops.voxel_query import voxel_query
from detection.ops.voxelize import VoxelGrid

REACH = (4, 4, 4)  # voxels (z, y, x) looked at on either side
NEIGHBOURS = 16
STRIDES = (2, 4, 8)  # of x_conv2, x_conv3, x_conv4


@dataclass(frozen=True)
class VoxelPoolSettings:
    """grid points along each side of a RoI, radii in metres for x_conv2 ... x_conv4, channels of each level's pooled
    features, and the width of the hidden layers."""

    grid: int = 6
    radii: tuple[float, float, float] = (0.4, 0.8, 1.6)
    channels: int = 32
    width: int = 256


def _normalised(in_channels: int, out_channels: int, axes: int) -> nn.ModuleList:
    """A product (`0.0`) and its normalisation (`0.1`)."""
    return nn.ModuleList(
        [
            nn.Sequential(
                PointwiseWeight(in_channels, out_channels, axes, bias=False),
                RowBatchNorm(out_channels),
            )
        ]
    )


class VoxelPool(nn.Module):
    """Features of up to 16 voxels round each grid point: voxel feature plus position, maximum, one more layer."""

    def __init__(self, in_channels: int, channels: int, stride: int, radius: float) -> None:
        super().__init__()
        self.channels, self.stride, self.radius = channels, stride, radius
        self.mlps_in = _normalised(in_channels, channels, 1)
        self.mlps_pos = _normalised(3, channels, 2)
        self.mlps_out = _normalised(channels, channels, 1)

    def forward(self, voxels: SparseTensor, grid: VoxelGrid, places: Tensor, frames: Tensor) -> Tensor:
        """Voxels of the level, places (M, 3) with their frames (M,) -> (M, channels).

        Where nothing is near, feature and position count as zeros (the position branch still adds its bias).
        """
        rows = voxel_query(voxels.sites, grid, self.stride, places, frames, REACH, self.radius, NEIGHBOURS)
        found = rows >= 0
        centres = grid.centres(voxels.sites.coords[:, 1:], self.stride)
        # One more row of zeros stands for "nothing near".
        features = F.pad(self._described(voxels.features), (0, 0, 0, 1))
        gather = torch.where(found, rows, len(centres))
        offset = (F.pad(centres, (0, 0, 0, 1))[gather] - places[:, None]) * found[..., None]
        near = features.index_select(0, gather.flatten()).view(*gather.shape, -1)
        pooled = maximum(F.relu(near + self.mlps_pos[0](offset)))
        return F.relu(self.mlps_out[0](pooled))

    def _described(self, features: Tensor) -> Tensor:
        """(N, C) -> (N, channels); without voxels there are no batch statistics to take."""
        if len(features):
            return cast(Tensor, self.mlps_in[0](features))
        return features.new_zeros(0, self.channels)


class VoxelRoIHead(nn.Module):
    """Second stage: grid points of each RoI pool from three levels of voxels, then fully connected layers."""

    def __init__(self, settings: VoxelPoolSettings, level_channels: Sequence[int], grid: VoxelGrid) -> None:
        super().__init__()
        self.settings, self.grid = settings, grid
        self.roi_grid_pool_layers = nn.ModuleList(
            VoxelPool(channels, settings.channels, stride, radius)
            for channels, stride, radius in zip(level_channels, STRIDES, settings.radii)
        )
        width, pooled = settings.width, settings.grid**3 * len(STRIDES) * settings.channels
        self.shared_fc_layer = nn.Sequential(*hidden_layers(pooled, (width, width), axes=0, dropout=0.3))
        self.cls_fc_layers = nn.Sequential(*hidden_layers(width, (width, width), axes=0, dropout=0.3))
        self.reg_fc_layers = nn.Sequential(*hidden_layers(width, (width, width), axes=0, dropout=0.3))
        self.cls_pred_layer = nn.Linear(width, 1)
        self.reg_pred_layer = nn.Linear(width, 7)
        nn.init.normal_(self.cls_pred_layer.weight, std=0.01)
        nn.init.zeros_(self.cls_pred_layer.bias)
        nn.init.normal_(self.reg_pred_layer.weight, std=0.001)
        nn.init.zeros_(self.reg_pred_layer.bias)

    def forward(self, levels: VoxelLevels, rois: Tensor) -> tuple[Tensor, Tensor]:
        """rois (B, P, 7) LiDAR form -> logits (B * P, 1), codes (B * P, 7)."""
        shared = self.shared_fc_layer(self.pool(levels, rois).flatten(1))
        return self.cls_pred_layer(self.cls_fc_layers(shared)), self.reg_pred_layer(self.reg_fc_layers(shared))

    def pool(self, levels: VoxelLevels, rois: Tensor) -> Tensor:
        """(B * P, grid^3, levels * channels): grid points outermost when flattened."""
        places = roi_grid_points(rois.flatten(0, 1), self.settings.grid)
        flat, frames = places.reshape(-1, 3), frame_index(rois, places.shape[1])
        pooled = [
            layer(voxels, self.grid, flat, frames)
            for layer, voxels in zip(self.roi_grid_pool_layers, levels.levels[1:])
        ]
        return torch.cat(pooled, dim=1).view(*places.shape[:2], -1)


class VoxelRCNN(VoxelTrunk):
    """Two stages on voxels."""

    def __init__(self, first: VoxelSettings, stages: TwoStageSettings, pool: VoxelPoolSettings) -> None:
        super().__init__(first)
        self.stages = stages
        self.roi_head = VoxelRoIHead(pool, first.widths[2:5], first.grid)

    def forward(self, clouds: Sequence[Tensor]) -> TwoStage:
        """Clouds of B frames, each (N_i, 3 + E) in the LiDAR frame -> both stages, proposals with test settings."""
        levels, out = self.first_stage(clouds)
        proposals = lidar_proposals(out, self.stages.proposals_test)
        return TwoStage(out, proposals, refinement(out, proposals, *self.roi_head(levels, proposals.rois)))

    def training_losses(self, batch: PointBatch, rng: np.random.Generator) -> dict[str, Tensor]:
        """Anchor and second-stage losses; clouds and boxes (G, 7) of the batch are in the LiDAR frame."""
        levels, out = self.first_stage(batch.clouds)
        losses = self.dense_head.losses(out.head, batch.boxes, batch.classes)
        proposals = lidar_proposals(out, self.stages.proposals_train)
        chosen = training_rois(out, proposals, batch, self.stages.rois, rng)
        losses |= roi_losses(chosen, self.stages.rois.foreground, *self.roi_head(levels, chosen.rois))
        return total(losses)

    @torch.no_grad()
    def raw_detections(self, batch: PointBatch) -> list[RawDetections]:
        """Refined boxes of each frame, LiDAR form."""
        return refined_detections(self(batch.clouds))
