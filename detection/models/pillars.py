"""PointPillars' encoder (Lang et al. 2019): points of a vertical pillar to one feature, pillars to a map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detection.models.fully_connected import EPS, MOMENTUM
from detection.models.layers import RowBatchNorm, maximum
from detection.ops.sparse_conv import Sites
from detection.ops.voxelize import VoxelGrid, Voxels, voxelize


class PillarLayer(nn.Module):
    """Linear layer, normalisation, ReLU and the maximum over the points of a pillar."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.linear = nn.Linear(in_channels, out_channels, bias=False)
        self.norm = RowBatchNorm(out_channels, EPS, MOMENTUM)

    def forward(self, rows: Tensor) -> Tensor:
        """(P, T, in) -> (P, out)."""
        return maximum(F.relu(self.norm(self.linear(rows))))


class PillarEncoder(nn.Module):
    """Points of each pillar, decorated with their offsets to its mean and its centre, to a bird's-eye map."""

    def __init__(self, grid: VoxelGrid, point_channels: int, channels: int) -> None:
        super().__init__()
        if grid.shape[0] != 1:
            raise ValueError(f"pillars: expected a grid one voxel high, got {grid.shape[0]}")
        self.grid, self.channels = grid, channels
        self.pfn_layers = nn.ModuleList([PillarLayer(point_channels + 6, channels)])

    def forward(self, clouds: Sequence[Tensor]) -> Tensor:
        """Clouds (N_i, 3 + E) -> (B, channels, Y, X)."""
        limit = self.grid.max_voxels[0 if self.training else 1]
        frames = [voxelize(self.grid.crop(cloud), self.grid, limit) for cloud in clouds]
        rows = torch.cat([self.decorated(voxels) for voxels in frames])
        features = cast(Tensor, self.pfn_layers[0](rows)) if len(rows) else rows.new_zeros(0, self.channels)
        coords = torch.cat([F.pad(voxels.coords, (1, 0), value=b) for b, voxels in enumerate(frames)])
        return Sites(coords, self.grid.shape, len(frames)).to_dense(features).squeeze(2)

    def decorated(self, voxels: Voxels) -> Tensor:
        """(V, T, 3 + E + 6): the point, its offset to the mean of the pillar's points, its offset to the centre.

        Empty places are zeros; they pass through the layer and its maximum like points, as in OpenPCDet.
        """
        xyz = voxels.points[..., :3]
        mean = xyz.sum(dim=1, keepdim=True) / voxels.counts[:, None, None]
        centre = self.grid.centres(voxels.coords).to(xyz)[:, None]
        rows = torch.cat([voxels.points, xyz - mean, xyz - centre], dim=-1)
        filled = torch.arange(rows.shape[1], device=rows.device) < voxels.counts[:, None]
        return rows * filled[..., None]
