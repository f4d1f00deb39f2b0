"""Geometric convolutions (Hu et al., PENet, ICRA 2021): a convolution sees where its pixels lie, coarse ones included.

The published weights rely on three oddities, kept here: the intrinsics are not divided by the scale (metric at full
size only), the vertical coordinate comes before the horizontal one, and all is measured in a window of 352 x 1216.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

WINDOW = (352, 1216)
# fx, fy, cx, cy that the published weights were trained with, for every frame: P_rect_02 of 2011_09_26, cut.
PUBLISHED_K = (721.5377, 721.5377, 596.5593, 161.354)
ENCODINGS = {"std": 0, "z": 1, "uv": 2, "xyz": 3}
SCALES = 6


def published_intrinsics() -> Tensor:
    """(3, 3) float32: the matrix of `PUBLISHED_K`."""
    fx, fy, cx, cy = PUBLISHED_K
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def position_map(places: Sequence[tuple[int, int]] | Tensor, height: int, width: int) -> Tensor:
    """(B, 2, height, width) column and row of every pixel in the window, from -1 to 1 over 1216 columns and 352 rows.

    places  row and column of each input's top left pixel in the window; below 0 and beyond it count on
    """
    corner = torch.as_tensor(places, dtype=torch.float32)
    rows = corner[:, :1] + torch.arange(height, device=corner.device)
    columns = corner[:, 1:] + torch.arange(width, device=corner.device)
    row = (2 * rows / (WINDOW[0] - 1) - 1)[:, :, None].expand(-1, -1, width)
    column = (2 * columns / (WINDOW[1] - 1) - 1)[:, None].expand(-1, height, -1)
    return torch.stack([column, row], dim=1)


def bottom_centre(height: int, width: int) -> tuple[int, int]:
    """Row and column in the window of an input that lies at its bottom, centred."""
    return WINDOW[0] - height, round((WINDOW[1] - width) / 2)


def pool_nearest(depth: Tensor) -> Tensor:
    """(B, 1, H, W) metres, 0 = none -> the smallest valid depth of each 2 x 2 block, 0 where it has none."""
    nearness = torch.where(depth > 0, -depth, torch.full_like(depth, -torch.inf))
    pooled = -F.max_pool2d(nearness, 2)
    return torch.where(torch.isinf(pooled), torch.zeros_like(pooled), pooled)


def geometric_maps(sparse: Tensor, position: Tensor, K: Tensor, encoding: str) -> list[Tensor]:
    """(B, ENCODINGS[encoding], H / s, W / s) for s = 1, 2, ..., 32.

    sparse    (B, 1, H, W) metres
    position  (B, 2, H, W) as `position_map` gives it
    K         (B, 3, 3), in pixels of the window
    """
    fx, fy, cx, cy = (K[:, i, j].view(-1, 1, 1, 1) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    maps = []
    for power in range(SCALES):
        if power:
            sparse, position = pool_nearest(sparse), F.avg_pool2d(position, 2)
        column, row = position[:, :1], position[:, 1:]
        if encoding == "xyz":
            vertical = sparse * (0.5 * (WINDOW[0] / 2**power) * (row + 1) - cy) / fy
            horizontal = sparse * (0.5 * (WINDOW[1] / 2**power) * (column + 1) - cx) / fx
            maps.append(torch.cat([vertical, horizontal, sparse], dim=1))
        else:
            maps.append({"std": sparse[:, :0], "z": sparse, "uv": torch.cat([row, column], dim=1)}[encoding])
    return maps


class GeometricBlock(nn.Module):
    """A basic residual block whose convolutions also see the geometric map of their input's scale."""

    def __init__(self, inputs: int, outputs: int, stride: int, geometry: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs + geometry, outputs, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs + geometry, outputs, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample: nn.Module | None = None
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(
                nn.Conv2d(inputs + geometry, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs)
            )

    def forward(self, features: Tensor, before: Tensor, after: Tensor) -> Tensor:
        """Features at the input's scale, and the geometric maps of the input's and of the output's scale."""
        seen = torch.cat([features, before], dim=1)
        inner = torch.relu(self.bn1(self.conv1(seen)))
        inner = self.bn2(self.conv2(torch.cat([after, inner], dim=1)))
        shortcut = features if self.downsample is None else self.downsample(seen)
        return torch.relu(inner + shortcut)
