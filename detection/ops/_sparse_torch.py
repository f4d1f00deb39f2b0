"""The searches of the sparse convolution in plain torch, for devices numba does not reach: sorted keys."""

from __future__ import annotations

import torch
from torch import Tensor


def find_rows(keys: Tensor, wanted: Tensor) -> Tensor:
    """Row of each wanted key among keys (N,) in any order; -1 where there is none. Shape of `wanted`."""
    if not len(keys):
        return torch.full_like(wanted, -1)
    ordered, rows = keys.sort()
    place = torch.searchsorted(ordered, wanted).clamp(max=len(keys) - 1)
    return torch.where(ordered[place] == wanted, rows[place], -1)


def linear_keys(coords: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """((b * Z + z) * Y + y) * X + x of coords (..., 4) b z y x."""
    b, z, y, x = coords.unbind(-1)
    return ((b * shape[0] + z) * shape[1] + y) * shape[2] + x


def unravel(keys: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Inverse of `linear_keys`: (N,) -> (N, 4) b z y x."""
    rest, x = keys // shape[2], keys % shape[2]
    rest, y = rest // shape[1], rest % shape[1]
    return torch.stack([rest // shape[0], rest % shape[0], y, x], dim=1)


def neighbour_pairs(coords: Tensor, shape: tuple[int, int, int], offsets: Tensor) -> tuple[Tensor, Tensor, list[int]]:
    """As the numba kernel of this name: sources, targets and their number per offset (K, 3) z y x."""
    keys, limits = linear_keys(coords, shape), coords.new_tensor(shape)
    sources, targets = [], []
    for offset in offsets:
        moved = coords.clone()
        moved[:, 1:] += offset
        inside = ((moved[:, 1:] >= 0) & (moved[:, 1:] < limits)).all(dim=1)
        rows = torch.where(inside, find_rows(keys, linear_keys(moved, shape)), -1)
        target = (rows >= 0).nonzero().squeeze(1)
        sources.append(rows[target])
        targets.append(target)
    empty = coords.new_zeros(0)
    return torch.cat([empty, *sources]), torch.cat([empty, *targets]), [len(rows) for rows in sources]


def window_pairs(
    coords: Tensor, taps: Tensor, stride: Tensor, padding: Tensor, out_shape: tuple[int, int, int]
) -> tuple[Tensor, Tensor, Tensor, list[int]]:
    """Active outputs (keys, ascending) of a strided convolution, and its pairs: sources, targets, number per tap."""
    limits = coords.new_tensor(out_shape)
    sources, keys = [], []
    for tap in taps:
        moved = coords[:, 1:] + padding - tap
        place = moved // stride
        meets = ((moved >= 0) & (moved % stride == 0) & (place < limits)).all(dim=1)
        source = meets.nonzero().squeeze(1)
        sources.append(source)
        keys.append(linear_keys(torch.cat([coords[source, :1], place[source]], dim=1), out_shape))
    out_keys, targets = torch.unique(torch.cat(keys), return_inverse=True)
    return out_keys, torch.cat(sources), targets, [len(rows) for rows in sources]
