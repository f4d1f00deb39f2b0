"""Obvious twins of the voxel operations: dense tensors and plain loops."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor


def dense_convolution(
    dense: Tensor, weight: Tensor, stride: tuple[int, int, int], padding: tuple[int, int, int]
) -> Tensor:
    """conv3d of (B, C, Z, Y, X) with a weight (out, kz, ky, kx, in)."""
    return F.conv3d(dense, weight.permute(0, 4, 1, 2, 3), stride=stride, padding=padding)


def active_outputs(
    active: Tensor, kernel: tuple[int, int, int], stride: tuple[int, int, int], padding: tuple[int, int, int]
) -> Tensor:
    """(M, 4) b z y x, sorted: outputs whose window holds an active cell of (B, Z, Y, X)."""
    seen = F.conv3d(active[:, None].double(), torch.ones(1, 1, *kernel).double(), stride=stride, padding=padding)
    return (seen[:, 0] > 0.5).nonzero()


def voxelize_loop(
    points: list[list[float]],
    low: tuple[float, ...],
    size: tuple[float, ...],
    shape: tuple[int, int, int],
    max_points: int,
    max_voxels: int,
) -> tuple[list[tuple[int, int, int]], list[list[list[float]]]]:
    """Coordinates z y x and the points of each voxel, one point after the other."""
    coords: list[tuple[int, int, int]] = []
    members: list[list[list[float]]] = []
    for point in points:
        x, y, z = (math.floor((value - start) / step) for value, start, step in zip(point, low, size))
        if not (0 <= z < shape[0] and 0 <= y < shape[1] and 0 <= x < shape[2]):
            continue
        if (z, y, x) not in coords:
            if len(coords) == max_voxels:
                continue
            coords.append((z, y, x))
            members.append([])
        own = members[coords.index((z, y, x))]
        if len(own) < max_points:
            own.append(point)
    return coords, members
