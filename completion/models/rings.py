"""Measured samples above and below every pixel, and the interpolation between them.

A spinning LiDAR writes nearly horizontal rings, so the two rings that enclose a pixel hold the samples that say most
about it. Interpolating them in inverse depth is exact on planes; at an edge one of the two is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

# A step to the side costs so many steps down: rings are sampled every two or three columns but 5 to 40 rows apart.
SIDE_COST = 2.5
# Distances are cut here (pixels); farther samples say no more than that there is none near.
FARTHEST = 64.0
# Depth where nothing was measured at all (metres): the middle of a street scene on a logarithmic scale.
NO_DEPTH = 20.0


@dataclass(frozen=True)
class Rings:
    """All (B, 1, H, W) float32: depths in metres, everywhere positive, and distances in pixels cut at 64.

    above, below                    nearest sample above and below; a missing one takes the other's value
    between                         their interpolation in inverse depth by distance
    distance_above, distance_below  64 where there is none
    """

    above: Tensor
    below: Tensor
    between: Tensor
    distance_above: Tensor
    distance_below: Tensor


@njit(cache=True, nogil=True)
def sweep(sparse, depth, cost):  # type: ignore[no-untyped-def]
    """Carries samples downwards and sideways; `cost` is steps down plus 2.5 times steps to the side."""
    height, width = sparse.shape
    for y in range(height):
        for x in range(width):
            if sparse[y, x] > 0:
                depth[y, x], cost[y, x] = sparse[y, x], 0
                continue
            best, value = np.float32(1e9), np.float32(0)
            if y > 0:
                for dx in range(-1, 2):
                    if 0 <= x + dx < width:
                        candidate = cost[y - 1, x + dx] + (1 if dx == 0 else SIDE_COST)
                        if candidate < best or (candidate == best and dx == 0):
                            best, value = candidate, depth[y - 1, x + dx]
            depth[y, x], cost[y, x] = value, best
        for x in range(1, width):
            if cost[y, x - 1] + SIDE_COST < cost[y, x]:
                depth[y, x], cost[y, x] = depth[y, x - 1], cost[y, x - 1] + SIDE_COST
        for x in range(width - 2, -1, -1):
            if cost[y, x + 1] + SIDE_COST < cost[y, x]:
                depth[y, x], cost[y, x] = depth[y, x + 1], cost[y, x + 1] + SIDE_COST


@njit(cache=True, nogil=True)
def interpolate_rows(first, last, out):  # type: ignore[no-untyped-def]
    """Rows first..last of `enclose` from what both sweeps left in out (5, H, W)."""
    for y in range(first, last):
        for x in range(out.shape[2]):
            above, below = out[3, y, x] < 1e6, out[4, y, x] < 1e6
            if above and below:
                w = (out[4, y, x] + 1e-3) / (out[3, y, x] + out[4, y, x] + 2e-3)
                out[2, y, x] = 1 / (w / out[0, y, x] + (1 - w) / out[1, y, x])
            else:
                only = out[0, y, x] if above else (out[1, y, x] if below else np.float32(NO_DEPTH))
                out[0, y, x] = out[1, y, x] = out[2, y, x] = only
            out[3, y, x] = min(out[3, y, x], np.float32(FARTHEST))
            out[4, y, x] = min(out[4, y, x], np.float32(FARTHEST))


@njit(cache=True, nogil=True)
def enclose(sparse):  # type: ignore[no-untyped-def]
    """(H, W) float32 sparse depth -> (5, H, W): above, below, between, distance above, distance below."""
    height, width = sparse.shape
    out = np.empty((5, height, width), dtype=np.float32)
    sweep(sparse, out[0], out[3])
    sweep(sparse[::-1], out[1, ::-1], out[4, ::-1])
    interpolate_rows(0, height, out)
    return out


def interpolate_rings(sparse: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sparse (H, W) float32 metres (0 = none) -> dense (H, W): `Rings.between`. A baseline without weights."""
    dense: NDArray[np.float32] = enclose(np.ascontiguousarray(sparse, dtype=np.float32))[2]
    return dense


def find_rings(sparse: Tensor) -> Rings:
    """Sparse depth (B, 1, H, W) in metres, 0 = none -> the rings round every pixel, on the device of `sparse`.

    Computed on the CPU (about 5 ms for 375 x 1242); without gradient.
    """
    maps = np.stack([enclose(np.ascontiguousarray(one)) for one in sparse[:, 0].detach().float().cpu().numpy()])
    tensor = torch.from_numpy(maps).to(sparse.device)
    return Rings(*(tensor[:, channel : channel + 1] for channel in range(5)))
