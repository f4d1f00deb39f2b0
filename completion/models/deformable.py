"""Modulated deformable sampling of one map, in plain torch operations: any device, gradients to everything.

The operation of Zhu et al., "Deformable ConvNets v2" (CVPR 2019), with a kernel of ones, one channel and one group, as
NLSPN uses it: every pixel sums K x K bilinear samples of the map with weights of its own. Corners outside the map
count 0. `completion.cpu.propagation` computes the same on a CPU, faster.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F


class Samples(NamedTuple):
    """Where N samples per pixel lie: four corners each, (B, 4, N, H, W).

    corner  into a map that `_bordered` made flat; share  of each corner, bilinear
    """

    corner: Tensor
    share: Tensor


def cells(kernel: int) -> list[tuple[int, int]]:
    """(row, column) of the cells of a kernel x kernel window from its centre, in reading order, the centre included."""
    half = kernel // 2
    return [(row, column) for row in range(-half, half + 1) for column in range(-half, half + 1)]


def with_centre(neighbours: Tensor, centre: Tensor) -> Tensor:
    """Maps of the n neighbours (B, n, ...) and of the centre (B, 1, ...) in reading order (B, n + 1, ...)."""
    middle = neighbours.shape[1] // 2
    return torch.cat((neighbours[:, :middle], centre, neighbours[:, middle:]), 1)


def without_centre(taps: Tensor) -> Tensor:
    """The maps of the neighbours alone, (B, n + 1, ...) -> (B, n, ...)."""
    middle = taps.shape[1] // 2
    return torch.cat((taps[:, :middle], taps[:, middle + 1 :]), 1)


def samples_at(offsets: Tensor, around: list[tuple[int, int]]) -> Samples:
    """Samples at p + cell + offset.

    offsets  (B, N, 2, H, W) rows and columns, in pixels
    around   the N cells, (row, column)
    """
    height, width = offsets.shape[-2:]
    cell = offsets.new_tensor(around)
    ys = torch.arange(height, dtype=offsets.dtype, device=offsets.device)[:, None] + cell[:, 0, None, None]
    xs = torch.arange(width, dtype=offsets.dtype, device=offsets.device) + cell[:, 1, None, None]
    # Farther out every corner lies outside; there the sample and its gradient are 0, as the border of zeros gives them.
    rows, columns = (ys + offsets[:, :, 0]).clamp(-1, height), (xs + offsets[:, :, 1]).clamp(-1, width)
    top, left = rows.detach().floor(), columns.detach().floor()
    down, right = rows - top, columns - left
    stride = width + 3
    # A NaN must not become an index; it reaches the output through its share.
    first = (top.nan_to_num(-1).long() + 1) * stride + left.nan_to_num(-1).long() + 1
    index = torch.stack((first, first + 1, first + stride, first + stride + 1), 1)
    up, beside = 1 - down, 1 - right
    return Samples(index, torch.stack((up * beside, up * right, down * beside, down * right), 1))


def _bordered(values: Tensor) -> Tensor:
    """(B, 1, H, W) with a border of zeros for the corners outside, flat (B, P)."""
    return F.pad(values, (1, 2, 1, 2)).flatten(1)


def _gathered(values: Tensor, index: Tensor) -> Tensor:
    return _bordered(values).gather(1, index.flatten(1)).view_as(index)


def sample(values: Tensor, offsets: Tensor, around: list[tuple[int, int]]) -> Tensor:
    """Bilinear samples (B, N, H, W) of a map (B, 1, H, W) at p + cell + offset, see `samples_at`."""
    corner, share = samples_at(offsets, around)
    return (_gathered(values, corner) * share).sum(1)


def times_confidence(affinities: Tensor, confidence: Tensor, offsets: Tensor) -> Tensor:
    """Affinities (B, n, H, W) times the confidence (B, 1, H, W) that each neighbour has at p + offset.

    offsets  (B, n, 2, H, W), pixels; no gradient flows into them
    """
    return affinities * sample(confidence, offsets.detach(), [(0, 0)] * affinities.shape[1])


def propagate(
    depth: Tensor, offsets: Tensor, weights: Tensor, iterations: int, kept: Tensor | None = None
) -> tuple[Tensor, ...]:
    """The map (B, 1, H, W) after each of the iterations.

    offsets  (B, K^2, 2, H, W), pixels, in reading order of the cells; the centre's are not used: it does not move
    weights  (B, K^2, H, W) of the pixel that reads
    kept     (B, 1, H, W) or None: where it is > 0 it replaces the map before each iteration (not after the last)
    """
    count = weights.shape[1]
    around = cells(round(count**0.5))
    del around[count // 2]
    corner, share = samples_at(without_centre(offsets), around)
    # All iterations read the same pixels with the same factors: one sparse matrix.
    factors = share * without_centre(weights)[:, None]
    centre = weights[:, count // 2, None]
    steps = []
    for _ in range(iterations):
        if kept is not None:
            depth = torch.where(kept > 0, kept, depth)
        depth = centre * depth + (_gathered(depth, corner) * factors).sum((1, 2))[:, None]
        steps.append(depth)
    return tuple(steps)
