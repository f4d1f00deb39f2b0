"""PV-RCNN's keypoints (Shi et al. 2020): few points that gather from raw points, voxels and the bird's-eye map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detection.models.layers import IndexedMLP, PointwiseWeight, RowBatchNorm
from detection.models.voxel_backbone import VoxelLevels
from detection.ops import ball_query, furthest_point_sample
from detection.ops.voxelize import VoxelGrid


@dataclass(frozen=True)
class BallSpec:
    """Two balls: radii in metres, most neighbours, and the widths of each ball's point network."""

    radii: tuple[float, float]
    neighbours: tuple[int, int]
    widths: tuple[int, ...]


def in_balls(sources: Sequence[Tensor], centres: Tensor, radius: float, neighbours: int) -> tuple[Tensor, Tensor]:
    """Neighbours of centres (B, M, 3) among B sources (N_i, 3): the first in index order nearer than `radius`.

    Returns rows (B * M, neighbours) of the stacked sources and offsets (B * M, neighbours, 3) from the centre. A ball
    without points gets the row behind the last one and zero offsets.
    """
    stacked = torch.cat([*sources, centres.new_zeros(1, 3)])
    rows, start = [], 0
    for source, own in zip(sources, centres):
        if len(source):
            index = ball_query(source, own, radius, neighbours)
            # The query answers 0 for an empty ball; whether point 0 is really inside tells the two apart.
            first = source[index[:, 0]]
            empty = (index[:, 0] == 0) & ((first - own).square().sum(dim=1) >= radius * radius)
            rows.append(torch.where(empty[:, None], len(stacked) - 1, index + start))
        else:
            rows.append(torch.full((len(own), neighbours), len(stacked) - 1, device=centres.device))
        start += len(source)
    gather = torch.cat(rows)
    offset = stacked[gather] - centres.reshape(-1, 1, 3)
    return gather, offset * (gather < len(stacked) - 1)[..., None]


class StackedSetAbstraction(nn.Module):
    """Point networks over the balls round given centres; empty balls see one point of zeros (OpenPCDet)."""

    def __init__(self, in_channels: int, spec: BallSpec) -> None:
        super().__init__()
        self.spec = spec
        self.mlps = nn.ModuleList(IndexedMLP((in_channels + 3, *spec.widths)) for _ in spec.radii)

    def forward(self, sources: Sequence[Tensor], features: Tensor | None, centres: Tensor) -> Tensor:
        """B sources (N_i, 3), stacked features (sum N_i, C), centres (B, M, 3) -> (B * M, 2 * widths[-1])."""
        padded = None if features is None else F.pad(features, (0, 0, 0, 1))
        described = []
        for radius, neighbours, mlp in zip(self.spec.radii, self.spec.neighbours, self.mlps):
            gather, offset = in_balls(sources, centres, radius, neighbours)
            described.append(cast(IndexedMLP, mlp).group_maximum(padded, offset, gather))
        return torch.cat(described, dim=1)


def keypoints(xyz: Tensor, count: int) -> Tensor:
    """(count, 3) furthest points of (N, 3), the first one first; fewer points are repeated in turn."""
    if not len(xyz):
        raise ValueError("keypoints: expected at least one point within the range, got none")
    chosen = furthest_point_sample(xyz, min(count, len(xyz)))
    return xyz[chosen.repeat(-(-count // len(chosen)))[:count]]


def read_map(bev: Tensor, places: Tensor) -> Tensor:
    """Bilinear values (M, C) of a map (C, Y, X) at places (M, 2), x y in cells; cell centres lie at whole numbers.

    As in OpenPCDet the four indices are clamped but their weights are taken from the clamped ones, so beyond the
    last row or column the weights cancel and the value is 0.
    """
    height, width = bev.shape[1:]
    lower = places.floor().long()
    x0, x1 = lower[:, 0].clamp(0, width - 1), (lower[:, 0] + 1).clamp(0, width - 1)
    y0, y1 = lower[:, 1].clamp(0, height - 1), (lower[:, 1] + 1).clamp(0, height - 1)
    x, y = places.unbind(1)
    values = (bev[:, y0, x0] * (x1 - x) + bev[:, y0, x1] * (x - x0)) * (y1 - y)
    values = values + (bev[:, y1, x0] * (x1 - x) + bev[:, y1, x1] * (x - x0)) * (y - y0)
    return values.T


# Balls of x_conv1 ... x_conv4; those of the raw points are x_conv1's.
KITTI_BALLS = (
    BallSpec((0.4, 0.8), (16, 16), (16, 16)),
    BallSpec((0.8, 1.2), (16, 32), (32, 32)),
    BallSpec((1.2, 2.4), (16, 32), (64, 64)),
    BallSpec((2.4, 4.8), (16, 32), (64, 64)),
)


@dataclass(frozen=True)
class KeypointSettings:
    """Keypoints per frame, the balls of raw points and of x_conv1 ... x_conv4, and the channels after fusion."""

    count: int = 2048
    raw: BallSpec = KITTI_BALLS[0]
    levels: tuple[BallSpec, BallSpec, BallSpec, BallSpec] = KITTI_BALLS
    channels: int = 128


@dataclass(frozen=True)
class Keypoints:
    """xyz (B, K, 3) LiDAR frame; gathered (B * K, C) before and features (B * K, C') after fusion."""

    xyz: Tensor
    gathered: Tensor
    features: Tensor


class VoxelSetAbstraction(nn.Module):
    """Keypoints with features of the map, the raw points and every level of voxels, in this order, fused."""

    def __init__(
        self,
        settings: KeypointSettings,
        grid: VoxelGrid,
        point_channels: int,
        level_channels: Sequence[int],
        bev_channels: int,
    ) -> None:
        super().__init__()
        self.settings, self.grid = settings, grid
        self.SA_layers = nn.ModuleList(
            StackedSetAbstraction(channels, spec) for channels, spec in zip(level_channels, settings.levels)
        )
        self.SA_rawpoints = StackedSetAbstraction(point_channels - 3, settings.raw)
        self.gathered_channels = bev_channels + 2 * sum(s.widths[-1] for s in (settings.raw, *settings.levels))
        self.vsa_point_feature_fusion = nn.Sequential(
            PointwiseWeight(self.gathered_channels, settings.channels, axes=0, bias=False),
            RowBatchNorm(settings.channels),
            nn.ReLU(),
        )

    def forward(self, clouds: Sequence[Tensor], levels: VoxelLevels) -> Keypoints:
        """Clouds (N_i, 3 + E) within the range, and the sparse backbone's output."""
        xyz = torch.stack([keypoints(cloud[:, :3], self.settings.count) for cloud in clouds])
        # Two divisions, voxels then cells, as the reference rounds; a cell's value counts at its lower corner.
        low, size = xyz.new_tensor(self.grid.low[:2]), xyz.new_tensor(self.grid.size[:2])
        places = (xyz[..., :2] - low) / size / 8
        extra = torch.cat([cloud[:, 3:] for cloud in clouds])
        gathered = [
            torch.cat([read_map(bev, place) for bev, place in zip(levels.bev, places)]),
            self.SA_rawpoints([cloud[:, :3] for cloud in clouds], extra if extra.shape[1] else None, xyz),
        ]
        for k, (voxels, layer) in enumerate(zip(levels.levels, self.SA_layers)):
            coords = voxels.sites.coords
            centres = self.grid.centres(coords[:, 1:], 2**k)
            frames = [coords[:, 0] == b for b in range(len(clouds))]
            # Ball queries need the voxels of a frame to stand together.
            order = torch.cat([frame.nonzero().squeeze(1) for frame in frames])
            gathered.append(layer([centres[frame] for frame in frames], voxels.features[order], xyz))
        rows = torch.cat(gathered, dim=1)
        return Keypoints(xyz, rows, self.vsa_point_feature_fusion(rows))
