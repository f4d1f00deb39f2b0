"""Candidate depths of every pixel: the measured samples nearest above and below it, in a few neighbouring columns.

A spinning LiDAR writes nearly horizontal rings with a sample every two or three columns, so "the next sample up and
down" finds the two rings that enclose a pixel, and the same at shifted columns finds both sides of an upright edge.
Interpolating the two enclosing samples in inverse depth is exact on planes.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

COLUMN_SHIFTS = (0, -4, 4, -10, 10)
SECOND_RING_ROWS = 3  # a ring's samples in adjacent columns differ by a row or two: the next ring starts above that
_MISSING = -30.0  # prior logit of a candidate that does not exist


@dataclass(frozen=True)
class Candidates:
    """K candidates per pixel, all (B, K, H, W); order: up, down at each column shift, then second up, second down.

    log_depth  natural logarithm of metres; of 10 m where the candidate is missing
    prior      logit: minus log of the vertical distance, minus a penalty for the shift; -30 where missing
    """

    log_depth: Tensor
    prior: Tensor

    @property
    def count(self) -> int:
        return int(self.prior.shape[1])


def candidate_count(shifts: tuple[int, ...] = COLUMN_SHIFTS) -> int:
    """Number of measured candidates per pixel."""
    return 2 * len(shifts) + 2


def _shift(x: Tensor, columns: int) -> Tensor:
    """(B, 1, H, W) with value x[..., c + columns] at column c; zeros enter at the border."""
    if columns == 0:
        return x
    if columns > 0:
        return F.pad(x, (0, columns))[..., columns:]
    return F.pad(x, (-columns, 0))[..., :columns]


def _fill_columns(sparse: Tensor) -> Tensor:
    """Give empty pixels the nearer of their two horizontal neighbours, so that most columns of a ring hold a sample."""
    left, right = _shift(sparse, -1), _shift(sparse, 1)
    both = (left > 0) & (right > 0)
    neighbour = torch.where(both, torch.minimum(left, right), torch.maximum(left, right))
    return torch.where(sparse > 0, sparse, neighbour)


def _next_above(depth: Tensor) -> tuple[Tensor, Tensor]:
    """Row index (int64, -1 if none) and depth of the last sample at or above each pixel of (B, 1, H, W)."""
    rows = torch.arange(depth.shape[2], device=depth.device).view(1, 1, -1, 1).expand(depth.shape)
    last = torch.where(depth > 0, rows, torch.full_like(rows, -1)).cummax(dim=2).values
    return last, depth.gather(2, last.clamp(min=0)) * (last >= 0)


def _above(depth: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Depth and distance in rows of the first and the second ring at or above each pixel; depth 0 where missing."""
    rows = torch.arange(depth.shape[2], device=depth.device).view(1, 1, -1, 1)
    last, first_depth = _next_above(depth)
    before = last - SECOND_RING_ROWS
    second = torch.where(before >= 0, last.gather(2, before.clamp(min=0)), torch.full_like(last, -1))
    second_depth = depth.gather(2, second.clamp(min=0)) * (second >= 0)
    return first_depth, (rows - last).to(depth.dtype), second_depth, (rows - second).to(depth.dtype)


def find_candidates(sparse: Tensor, shifts: tuple[int, ...] = COLUMN_SHIFTS) -> Candidates:
    """Sparse depth (B, 1, H, W) in metres, 0 = none -> candidates of every pixel. Works on an all-zero map."""
    filled = _fill_columns(sparse)
    up, up_rows, up2, up2_rows = _above(filled)
    down, down_rows, down2, down2_rows = (x.flip(2) for x in _above(filled.flip(2)))
    depths, priors = [], []
    for columns in shifts:
        for depth, rows in ((up, up_rows), (down, down_rows)):
            depths.append(_shift(depth, columns))
            priors.append(-torch.log(_shift(rows, columns) + 0.5) - 0.4 * abs(columns))
    for depth, rows in ((up2, up2_rows), (down2, down2_rows)):
        depths.append(depth)
        priors.append(-torch.log(rows + 0.5) - 4.0)
    depth, prior = torch.cat(depths, 1), torch.cat(priors, 1)
    exists = depth > 0
    log_depth = torch.log(torch.where(exists, depth, torch.full_like(depth, 10.0)))
    return Candidates(log_depth, torch.where(exists, prior, torch.full_like(prior, _MISSING)))
