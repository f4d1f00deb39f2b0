"""From points to voxels, in an order that depends on nothing but the order of the points."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from detection.ops._sparse_torch import linear_keys


@dataclass(frozen=True)
class VoxelGrid:
    """A regular grid in the LiDAR frame.

    low, high   x y z of its borders, metres (low inside, high outside)        size  x y z of a voxel, metres
    max_points  points kept per voxel     max_voxels  voxels kept per frame: (in training, otherwise)
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    size: tuple[float, float, float]
    max_points: int
    max_voxels: tuple[int, int]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of voxels (z, y, x)."""
        x, y, z = (round((high - low) / size) for low, high, size in zip(self.low, self.high, self.size))
        return z, y, x

    def crop(self, points: Tensor) -> Tensor:
        """The rows of points (N, 3 + E) within the borders of x and y, borders included; z is left to the voxels."""
        xy, low, high = points[:, :2], points.new_tensor(self.low[:2]), points.new_tensor(self.high[:2])
        return points[((xy >= low) & (xy <= high)).all(dim=1)]

    def centres(self, coords: Tensor, stride: int = 1) -> Tensor:
        """(..., 3) float32 x y z of the voxels (..., 3) z y x of a grid coarser by `stride`."""
        low = torch.tensor(self.low, dtype=torch.float32, device=coords.device)
        size = torch.tensor(self.size, dtype=torch.float32, device=coords.device) * stride
        return (coords.flip(-1).to(torch.float32) + 0.5) * size + low


@dataclass(frozen=True)
class Voxels:
    """The voxels of one frame, in the order of their first point.

    points  (V, T, 3 + E) their points, first come first kept, zeros behind them        counts  (V,) int64, at most T
    coords  (V, 3) int64 z y x
    """

    points: Tensor
    counts: Tensor
    coords: Tensor


def voxelize(points: Tensor, grid: VoxelGrid, max_voxels: int) -> Voxels:
    """Group points (N, 3 + E) x y z ... by the voxel floor((p - low) / size), float32 arithmetic.

    Voxels are made in the order of their first point until there are `max_voxels`; the points of later ones are lost,
    those of earlier ones still count. Any device. Raises ValueError for another shape.
    """
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points: expected (N, 3 or more) x y z ..., got shape {tuple(points.shape)}")
    low, size = points.new_tensor(grid.low), points.new_tensor(grid.size)
    place = ((points[:, :3] - low) / size).floor()
    limits = points.new_tensor(grid.shape[::-1])
    inside = ((place >= 0) & (place < limits)).all(dim=1).nonzero().squeeze(1)
    coords = place[inside].long().flip(1)
    keys = linear_keys(torch.nn.functional.pad(coords, (1, 0)), grid.shape)
    # Points of a voxel stand together and in their own order; its number is the rank of its first point.
    ordered, order = keys.sort(stable=True)
    is_first = torch.ones_like(ordered, dtype=torch.bool)
    is_first[1:] = ordered[1:] != ordered[:-1]
    start = is_first.nonzero().squeeze(1)
    group = is_first.cumsum(0) - 1
    by_first_point = order[start].argsort()
    number = torch.empty_like(by_first_point)
    number[by_first_point] = torch.arange(len(start), device=points.device)
    slot = torch.arange(len(order), device=points.device) - start[group]
    count = min(len(start), max_voxels)
    kept = (slot < grid.max_points) & (number[group] < count)
    filled = points.new_zeros(count, grid.max_points, points.shape[1])
    filled[number[group[kept]], slot[kept]] = points[inside[order[kept]]]
    counts = torch.zeros(count, dtype=torch.int64, device=points.device)
    counts.index_add_(0, number[group[kept]], torch.ones_like(slot[kept]))
    return Voxels(filled, counts, coords[order[start[by_first_point[:count]]]])
