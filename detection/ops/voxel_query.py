"""Voxel query (Voxel-RCNN, Deng et al. 2021): active voxels round a place, found by their indices."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from detection.ops._sparse_torch import find_rows, linear_keys
from detection.ops.sparse_conv import Sites, Triple
from detection.ops.voxelize import VoxelGrid

_CENTRES = 512  # per thread; and per block on other devices


def voxel_query(
    sites: Sites,
    grid: VoxelGrid,
    stride: int,
    centres: Tensor,
    frames: Tensor,
    reach: Triple,
    radius: float,
    nsample: int,
) -> Tensor:
    """For every centre the first `nsample` active voxels of its frame, in z, y, x order.

    sites    voxels of the grid coarser by `stride`        centres (M, 3) x y z metres     frames (M,) int64
    reach    voxels (z, y, x) to look at on either side of the voxel the centre lies in
    radius   metres; a voxel centre at exactly this distance counts
    Returns (M, nsample) int64 rows of the sites; missing ones repeat the first, a row of -1 has none.
    """
    places = centres.detach().to(torch.float32).contiguous()
    low, size = places.new_tensor(grid.low), places.new_tensor(grid.size)
    # The voxel of stride 1 first, then the coarser one, as the reference divides.
    index = ((places - low) / size).floor().long() // stride
    coords = torch.cat([frames[:, None], index.flip(1)], dim=1)
    coarse, radius2 = size * stride, float(np.float32(radius) * np.float32(radius))
    if places.device.type != "cpu":
        blocks = zip(places.split(_CENTRES), coords.split(_CENTRES))
        parts = [_query_torch(sites, place, at, reach, low, coarse, radius2, nsample) for place, at in blocks]
        return torch.cat([coords.new_zeros(0, nsample), *parts])

    from detection.ops import _sparse_kernels
    from detection.ops._numba import for_ranges

    keys, rows = sites.table()
    found = np.empty((len(places), nsample), np.int64)
    values, cells = places.numpy(), coords.numpy()
    shape, reaches = np.array(sites.shape), np.array(reach)

    def query(i: int, j: int) -> None:
        _sparse_kernels.voxel_query(
            values[i:j],
            cells[i:j],
            shape,
            reaches,
            low.numpy(),
            coarse.numpy(),
            radius2,
            keys,
            rows,
            found[i:j],
        )

    for_ranges(query, len(values), torch.get_num_threads(), _CENTRES)
    return torch.from_numpy(found)


def _query_torch(
    sites: Sites,
    centres: Tensor,
    coords: Tensor,
    reach: Triple,
    low: Tensor,
    size: Tensor,
    radius2: float,
    nsample: int,
) -> Tensor:
    """`voxel_query` on any device, all candidates at once."""
    steps = [torch.arange(-n, n + 1, device=centres.device) for n in reach]
    around = torch.nn.functional.pad(torch.cartesian_prod(*steps), (1, 0))
    cells = coords[:, None] + around
    inside = ((cells[..., 1:] >= 0) & (cells[..., 1:] < cells.new_tensor(sites.shape))).all(dim=-1)
    offset = (cells[..., 1:].flip(-1).to(torch.float32) + 0.5) * size + low - centres[:, None]
    x, y, z = offset.unbind(-1)
    inside &= x * x + y * y + z * z <= radius2
    rows = find_rows(linear_keys(sites.coords, sites.shape), linear_keys(cells, sites.shape))
    hit = inside & (rows >= 0)
    first = hit.int().argsort(dim=1, descending=True, stable=True)[:, :nsample]
    found = torch.where(hit.gather(1, first), rows.gather(1, first), -1)
    return torch.where(found < 0, found[:, :1], found)
