"""TWISE's output algebra written out, step by step, from the three raw heads."""

from __future__ import annotations

import torch
from torch import Tensor


def up2(x: Tensor) -> Tensor:
    """Bilinear doubling with aligned corners as two small matrix products."""

    def matrix(n: int) -> Tensor:
        weights = torch.zeros(2 * n, n)
        for row in range(2 * n):
            position = row * (n - 1) / (2 * n - 1)
            left = min(int(position), n - 2) if n > 1 else 0
            weights[row, left] += 1 - (position - left)
            if n > 1:
                weights[row, left + 1] += position - left
        return weights

    return matrix(x.shape[-2]) @ x @ matrix(x.shape[-1]).T


def fuse(head: Tensor) -> Tensor:
    sigma = 1 / (1 + torch.exp(-head[:, 2:3]))
    return sigma * head[:, 0:1] + (1 - sigma) * head[:, 1:2]


def outputs(r1: Tensor, r2: Tensor, r4: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    out4 = r4
    out2 = torch.cat([r2[:, :2] + up2(r4[:, :2]), r2[:, 2:]], 1)
    out1 = torch.cat([r1[:, :2] + up2(out2[:, :2]), r1[:, 2:]], 1)
    return out1, out2, out4


def guides(r2: Tensor, r4: Tensor) -> tuple[Tensor, Tensor]:
    """What stages 2 and 3 receive beside the sparse map: p_2 and p_1."""
    p2 = up2(fuse(r4))
    return p2, up2(fuse(r2) + p2)


def pooled(depth: Tensor, factor: int) -> Tensor:
    """Mean over measured pixels of each block, with the published 1e-4."""
    batch, _, height, width = depth.shape
    out = torch.zeros(batch, 1, height // factor, width // factor)
    for b in range(batch):
        for i in range(height // factor):
            for j in range(width // factor):
                block = depth[b, 0, i * factor : (i + 1) * factor, j * factor : (j + 1) * factor]
                share = (block > 0).float().mean()
                out[b, 0, i, j] = block.mean() / (share + 1e-4)
    return out
