"""Sparse 3D convolutions from voxels to a bird's-eye map, eight times coarser (SECOND; OpenPCDet's VoxelBackBone8x)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from detection.models.fully_connected import EPS, MOMENTUM
from detection.models.layers import RowBatchNorm
from detection.ops.sparse_conv import Sites, Triple, sparse_convolution
from detection.ops.voxelize import VoxelGrid, voxelize


@dataclass(frozen=True)
class SparseTensor:
    """features (N, C) of the active voxels `sites`."""

    features: Tensor
    sites: Sites

    def dense(self) -> Tensor:
        """(B, C, Z, Y, X), zero where inactive."""
        return self.sites.to_dense(self.features)


def mean_voxels(clouds: Sequence[Tensor], grid: VoxelGrid, max_voxels: int) -> SparseTensor:
    """Clouds (N_i, 3 + E) -> the mean of the points kept in each voxel; the grid gets one more layer on top."""
    features, coords = [], []
    for b, cloud in enumerate(clouds):
        voxels = voxelize(grid.crop(cloud), grid, max_voxels)
        features.append(voxels.points.sum(dim=1) / voxels.counts[:, None])
        coords.append(F.pad(voxels.coords, (1, 0), value=b))
    z, y, x = grid.shape
    return SparseTensor(torch.cat(features), Sites(torch.cat(coords), (z + 1, y, x), len(clouds)))


class SparseWeight(nn.Module):
    """Weight (out, kz, ky, kx, in) of a sparse convolution, in spconv 2.x's layout."""

    def __init__(self, in_channels: int, out_channels: int, kernel: Triple) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(out_channels, *kernel, in_channels))
        fan_in = in_channels * kernel[0] * kernel[1] * kernel[2]
        nn.init.normal_(self.weight, std=(2 / fan_in) ** 0.5)


class SparseBlock(nn.Module):
    """Sparse convolution (`0`), normalisation over the active voxels (`1`), ReLU.

    stride, padding  None: submanifold, the output has the very sites of the input
    """

    def __init__(
        self, in_channels: int, out_channels: int, kernel: Triple, window: tuple[Triple, Triple] | None
    ) -> None:
        super().__init__()
        self.kernel, self.window = kernel, window
        self.add_module("0", SparseWeight(in_channels, out_channels, kernel))
        self.add_module("1", RowBatchNorm(out_channels, EPS, MOMENTUM))

    def forward(self, voxels: SparseTensor) -> SparseTensor:
        """Voxels in, voxels out."""
        if self.window is None:
            sites, book = voxels.sites, voxels.sites.submanifold(self.kernel)
        else:
            sites, book = voxels.sites.strided(self.kernel, *self.window)
        weight, norm = cast(SparseWeight, self.get_submodule("0")).weight, self.get_submodule("1")
        features = sparse_convolution(voxels.features, weight, book)
        if len(features):  # batch statistics of nothing are undefined
            features = norm(features)
        return SparseTensor(F.relu(features, inplace=True), sites)


def _submanifold(in_channels: int, out_channels: int) -> SparseBlock:
    return SparseBlock(in_channels, out_channels, (3, 3, 3), None)


def _level(in_channels: int, channels: int, padding: Triple) -> nn.Sequential:
    """Half the resolution, then two submanifold convolutions."""
    down = SparseBlock(in_channels, channels, (3, 3, 3), ((2, 2, 2), padding))
    return nn.Sequential(down, _submanifold(channels, channels), _submanifold(channels, channels))


@dataclass(frozen=True)
class VoxelLevels:
    """x_conv1 ... x_conv4 (strides 1, 2, 4, 8 of the voxels) and bev (B, C * D, Y / 8, X / 8), channel c * D + d."""

    levels: tuple[SparseTensor, ...]
    bev: Tensor


# Channels of conv_input, conv1 ... conv4 and conv_out.
Widths = tuple[int, int, int, int, int, int]
KITTI_WIDTHS: Widths = (16, 16, 32, 64, 64, 128)


class VoxelBackbone(nn.Module):
    """Four levels of sparse convolutions and a last one that halves the height."""

    def __init__(self, point_channels: int, widths: Widths = KITTI_WIDTHS) -> None:
        super().__init__()
        self.widths = widths
        self.conv_input = _submanifold(point_channels, widths[0])
        self.conv1 = nn.Sequential(_submanifold(widths[0], widths[1]))
        self.conv2 = _level(widths[1], widths[2], (1, 1, 1))
        self.conv3 = _level(widths[2], widths[3], (1, 1, 1))
        self.conv4 = _level(widths[3], widths[4], (0, 1, 1))
        self.conv_out = SparseBlock(widths[4], widths[5], (3, 1, 1), ((2, 1, 1), (0, 0, 0)))

    def forward(self, voxels: SparseTensor) -> VoxelLevels:
        """Voxels (features of the points' mean) -> VoxelLevels."""
        x_conv1 = self.conv1(self.conv_input(voxels))
        x_conv2 = self.conv2(x_conv1)
        x_conv3 = self.conv3(x_conv2)
        x_conv4 = self.conv4(x_conv3)
        dense = self.conv_out(x_conv4).dense()
        return VoxelLevels((x_conv1, x_conv2, x_conv3, x_conv4), dense.flatten(1, 2))


def bev_channels(grid: VoxelGrid, widths: Widths) -> int:
    """Channels of the bird's-eye map: those of conv_out times the layers of height that remain."""
    z = grid.shape[0] + 1
    for padding in (1, 1, 0, 0):
        z = (z + 2 * padding - 3) // 2 + 1
    return widths[5] * z
