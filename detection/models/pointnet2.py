"""PointNet++ with multi-scale grouping (Qi et al. 2017), the backbone of PointRCNN; features are rows (B, N, C)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detection.models.layers import IndexedMLP, PointMLP, SharedMLP, maximum, normalise_relu, project_relu
from detection.ops import ball_query, furthest_point_sample, interpolation_weights, three_nn

# How a checkpoint names the layers of a point network.
AnyMLP = SharedMLP | IndexedMLP


@dataclass(frozen=True)
class SetAbstractionSpec:
    """One level: `points` centres; per scale a radius in metres, a number of neighbours, and the widths of its MLP."""

    points: int
    radii: tuple[float, ...]
    neighbours: tuple[int, ...]
    widths: tuple[tuple[int, ...], ...]

    @property
    def out_channels(self) -> int:
        """Channels after concatenating the scales."""
        return sum(widths[-1] for widths in self.widths)


# PointRCNN, EPNet and OpenPCDet share these (yaml SA_CONFIG, FP_MLPS).
KITTI_LEVELS = (
    SetAbstractionSpec(4096, (0.1, 0.5), (16, 32), ((16, 16, 32), (32, 32, 64))),
    SetAbstractionSpec(1024, (0.5, 1.0), (16, 32), ((64, 64, 128), (64, 96, 128))),
    SetAbstractionSpec(256, (1.0, 2.0), (16, 32), ((128, 196, 256), (128, 196, 256))),
    SetAbstractionSpec(64, (2.0, 4.0), (16, 32), ((256, 256, 512), (256, 384, 512))),
)
KITTI_PROPAGATION = ((128, 128), (256, 256), (512, 512), (512, 512))


def gather_rows(values: Tensor, index: Tensor) -> Tensor:
    """values (B, N, C), index (B, ...) int64 -> (B, ..., C)."""
    flat = flat_index(index, values.shape[1])
    return values.reshape(-1, values.shape[-1]).index_select(0, flat.reshape(-1)).view(*index.shape, values.shape[-1])


def flat_index(index: Tensor, rows: int) -> Tensor:
    """Index (B, ...) within each batch entry of `rows` rows -> index into the (B * rows) stacked rows."""
    start = torch.arange(len(index), device=index.device) * rows
    return index + start.view(-1, *([1] * (index.dim() - 1)))


class SetAbstraction(nn.Module):
    """Sample centres by furthest points, group neighbours in balls, describe each group by a point network."""

    def __init__(
        self, in_channels: int, spec: SetAbstractionSpec, norm: bool = True, mlp: type[AnyMLP] = SharedMLP
    ) -> None:
        super().__init__()
        self.spec = spec
        self.mlps = nn.ModuleList(mlp((in_channels + 3, *widths), norm) for widths in spec.widths)

    def forward(self, xyz: Tensor, features: Tensor | None) -> tuple[Tensor, Tensor]:
        """xyz (B, N, 3), features (B, N, C) or None -> centres (B, M, 3), features (B, M, C').

        Groups are the first neighbours in index order within a ball (strictly inside), so the input must be shuffled;
        the first centre is point 0. Neighbours are relative to the centre, in metres.
        """
        centres = gather_rows(xyz, furthest_point_sample(xyz, self.spec.points))
        source = None if features is None else features.reshape(-1, features.shape[-1])
        described = []
        for radius, neighbours, mlp in zip(self.spec.radii, self.spec.neighbours, self.mlps):
            index = ball_query(xyz, centres, radius, neighbours)
            offset = gather_rows(xyz, index) - centres.unsqueeze(2)
            rows = index.shape[0] * index.shape[1]
            gather = flat_index(index, xyz.shape[1]).view(rows, neighbours)
            groups = cast(PointMLP, mlp).group_maximum(source, offset.view(rows, neighbours, 3), gather)
            described.append(groups.view(*centres.shape[:2], -1))
        return centres, torch.cat(described, dim=-1)


class GroupAll(nn.Module):
    """The last level of a second stage: one group of all points, coordinates not re-centred."""

    def __init__(
        self, in_channels: int, widths: Sequence[int], norm: bool = True, mlp: type[AnyMLP] = SharedMLP
    ) -> None:
        super().__init__()
        self.mlps = nn.ModuleList([mlp((in_channels + 3, *widths), norm)])

    def forward(self, xyz: Tensor, features: Tensor) -> Tensor:
        """xyz (B, N, 3), features (B, N, C) -> (B, C')."""
        rows = torch.cat([xyz, features], dim=-1)
        return maximum(self.mlps[0](rows))


def interpolate_rows(unknown: Tensor, known: Tensor, features: Tensor) -> Tensor:
    """Inverse-distance mean of the three nearest known points: (B, N, 3), (B, M, 3), (B, M, C) -> (B, N, C).

    Weights 1 / (d + 1e-8) with d the distance in metres (not squared), normalised (PointNet++, eq. 2 with p = 1).
    """
    distance, index = three_nn(unknown, known)
    weight = interpolation_weights(distance)
    rows = flat_index(index, known.shape[1]).reshape(-1, 3)
    channels = features.shape[-1]
    mixed = F.embedding_bag(
        rows, features.reshape(-1, channels), mode="sum", per_sample_weights=weight.reshape(-1, 3).to(features.dtype)
    )
    return mixed.view(*unknown.shape[:2], channels)


class FeaturePropagation(nn.Module):
    """Carry features from few points to many: three-point interpolation, skip connection, shared MLP."""

    def __init__(self, in_channels: int, widths: Sequence[int], mlp: type[AnyMLP] = SharedMLP) -> None:
        super().__init__()
        self.mlp = mlp((in_channels, *widths))

    def forward(self, unknown: Tensor, known: Tensor, skip: Tensor | None, features: Tensor) -> Tensor:
        """unknown (B, N, 3), known (B, M, 3), skip (B, N, C1) or None, features (B, M, C2) -> (B, N, C')."""
        (conv, norm), *others = self.mlp.stages()
        # The product with the interpolated columns is linear, so it is taken on the fewer known points.
        weight = conv.matrix
        channels = features.shape[-1]
        rows = interpolate_rows(unknown, known, F.linear(features, weight[:, :channels]))
        if skip is not None:
            rows = rows + F.linear(skip, weight[:, channels:])
        rows = normalise_relu(norm, rows)
        for conv, norm in others:
            rows = project_relu(conv, norm, rows)
        return rows


class PointNet2Backbone(nn.Module):
    """Four (or fewer) set abstractions down, as many feature propagations up; one feature per input point."""

    def __init__(
        self,
        extra_channels: int,
        levels: Sequence[SetAbstractionSpec] = KITTI_LEVELS,
        propagation: Sequence[Sequence[int]] = KITTI_PROPAGATION,
        mlp: type[AnyMLP] = SharedMLP,
    ) -> None:
        super().__init__()
        self.extra_channels = extra_channels
        skips = [extra_channels, *(level.out_channels for level in levels)]
        self.SA_modules = nn.ModuleList(SetAbstraction(skips[k], level, mlp=mlp) for k, level in enumerate(levels))
        below = [*(widths[-1] for widths in propagation[1:]), skips[-1]]
        self.FP_modules = nn.ModuleList(
            FeaturePropagation(below[k] + skips[k], widths, mlp) for k, widths in enumerate(propagation)
        )
        self.out_channels = propagation[0][-1]

    def forward(self, points: Tensor) -> Tensor:
        """points (B, N, 3 + E) x y z and E extra channels -> (B, N, C) features in the order of the points."""
        if points.shape[-1] != 3 + self.extra_channels:
            raise ValueError(
                f"backbone: expected (B, N, {3 + self.extra_channels}) x y z and {self.extra_channels} extra channels, "
                f"got {tuple(points.shape)}"
            )
        xyz = [points[..., :3].contiguous()]
        features: list[Tensor | None] = [points[..., 3:].contiguous() if self.extra_channels else None]
        for level in self.SA_modules:
            centres, described = level(xyz[-1], features[-1])
            xyz.append(centres)
            features.append(described)
        for k in reversed(range(len(self.FP_modules))):
            features[k] = self.FP_modules[k](xyz[k], xyz[k + 1], features[k], features[k + 1])
        return cast(Tensor, features[0])
