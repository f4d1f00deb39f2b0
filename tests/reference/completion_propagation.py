"""PENet's propagation pixel by pixel, and the published form of its weight shift: fixed 0/1 convolution kernels."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F


def scattered(
    depth: NDArray[np.float64], start: NDArray[np.float64], guide: NDArray[np.float64]
) -> NDArray[np.float64]:
    """One step: every pixel (H, W) adds its share to each neighbour; guide (k^2 - 1, H, W) raw, in reading order."""
    kernel = round((len(guide) + 1) ** 0.5)
    cells = [(i - kernel // 2, j - kernel // 2) for i in range(kernel) for j in range(kernel)]
    cells.remove((0, 0))
    height, width = depth.shape
    result = np.zeros_like(depth)
    for y in range(height):
        for x in range(width):
            shares = guide[:, y, x] / np.abs(guide[:, y, x]).sum()
            result[y, x] += (1 - shares.sum()) * start[y, x]
            for (down, right), share in zip(cells, shares):
                if 0 <= y + down < height and 0 <= x + right < width:
                    result[y + down, x + right] += share * depth[y, x]
    return result


def shifted_by_kernels(weights: Tensor) -> Tensor:
    """(B, k^2, H, W) by a convolution that reads channel k^2 - 1 - o at cell o for output o."""
    count = weights.shape[1]
    kernel = round(count**0.5)
    fixed = torch.zeros(count, count, kernel, kernel)
    for out in range(count):
        fixed[out, count - 1 - out, out // kernel, out % kernel] = 1
    return F.conv2d(weights, fixed, padding=kernel // 2)


def smallest_valid(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Minimum of the positive depths of every 2 x 2 block, 0 without one."""
    result = np.zeros((depth.shape[0] // 2, depth.shape[1] // 2), np.float32)
    for y in range(result.shape[0]):
        for x in range(result.shape[1]):
            block = depth[2 * y : 2 * y + 2, 2 * x : 2 * x + 2]
            result[y, x] = block[block > 0].min() if (block > 0).any() else 0
    return result
