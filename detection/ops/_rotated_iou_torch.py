"""The arithmetic of `rotated_iou` on tensors of any device, and the choice between the two."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from detection.ops._rounding import RESIDUE


def on_device(numpy_function: Callable[..., Any], torch_function: Callable[..., Any], a: Tensor, b: Tensor) -> Tensor:
    """Numba where the memory can be shared with numpy, torch elsewhere; no gradient, dtype and device of `a`."""
    for name, boxes in (("boxes_a", a), ("boxes_b", b)):
        if boxes.ndim != 2 or boxes.shape[1] != 7:
            raise ValueError(f"{name}: expected (N, 7) boxes x y z h w l ry, got shape {tuple(boxes.shape)}")
    with torch.no_grad():
        if a.device.type == "cpu" and b.device.type == "cpu":
            result = torch.from_numpy(numpy_function(a.detach().double().numpy(), b.detach().double().numpy()))
        else:
            result = torch_function(a.double(), b.double())
        return result.to(a.dtype)


def _clamped_mean(xa: Tensor, xb: Tensor, limit: Tensor) -> Tensor:
    low, high = torch.minimum(xa, xb), torch.maximum(xa, xb)
    span = torch.where(high > low, high - low, 1.0)
    below = ((-limit).minimum(high) - low).clamp(min=0.0) / span
    above = (high - limit.maximum(low)).clamp(min=0.0) / span
    middle = 0.5 * (low.maximum(-limit).minimum(limit) + high.minimum(limit).maximum(-limit))
    return limit * (above - below) + middle * (1.0 - above - below)


def _bev_intersection(a: Tensor, b: Tensor) -> Tensor:
    """Area of intersection of boxes (..., 7) that broadcast against each other."""
    half_l, half_w = 0.5 * a[..., 5, None], 0.5 * a[..., 4, None]
    dx, dz = b[..., 0] - a[..., 0], b[..., 2] - a[..., 2]
    cos_a, sin_a = torch.cos(a[..., 6]), torch.sin(a[..., 6])
    turn = b[..., 6] - a[..., 6]
    cos, sin = torch.cos(turn)[..., None], torch.sin(turn)[..., None]
    along = 0.5 * b[..., 5, None] * b.new_tensor([1.0, -1.0, -1.0, 1.0])
    across = 0.5 * b[..., 4, None] * b.new_tensor([1.0, 1.0, -1.0, -1.0])
    x0 = (dx * cos_a - dz * sin_a)[..., None] + along * cos + across * sin  # (..., 4) corners of b in the frame of a
    z0 = (dx * sin_a + dz * cos_a)[..., None] - along * sin + across * cos
    x1, z1 = x0.roll(-1, dims=-1), z0.roll(-1, dims=-1)

    za, zb = z0.maximum(-half_w).minimum(half_w), z1.maximum(-half_w).minimum(half_w)
    slope = (x1 - x0) / torch.where(z1 == z0, 1.0, z1 - z0)
    mean = _clamped_mean(x0 + (za - z0) * slope, x1 + (zb - z1) * slope, half_l)
    area = (mean * (zb - za)).sum(dim=-1)
    residue = RESIDUE / 4 * (a[..., 4] * a[..., 5] + b[..., 4] * b[..., 5])
    solid = (area > residue) & (a[..., 4] > 0) & (a[..., 5] > 0) & (b[..., 4] > 0) & (b[..., 5] > 0)
    return torch.where(solid, area, 0.0)


def _ratio(shared: Tensor, total: Tensor) -> Tensor:
    return (shared / torch.where(shared > 0, total - shared, 1.0)).clamp(max=1.0)


def _volume_iou(a: Tensor, b: Tensor) -> Tensor:
    top = torch.maximum(a[..., 1] - a[..., 3], b[..., 1] - b[..., 3])
    height = (torch.minimum(a[..., 1], b[..., 1]) - top).clamp(min=0.0)
    return _ratio(_bev_intersection(a, b) * height, a[..., 3:6].prod(dim=-1) + b[..., 3:6].prod(dim=-1))


def iou_bev_torch(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) bird's-eye IoU of boxes (N, 7) and (M, 7), float64."""
    a, b = a[:, None], b[None]
    return _ratio(_bev_intersection(a, b), a[..., 4] * a[..., 5] + b[..., 4] * b[..., 5])


def iou_3d_torch(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) 3D IoU of boxes (N, 7) and (M, 7), float64."""
    return _volume_iou(a[:, None], b[None])


def iou_3d_aligned_torch(a: Tensor, b: Tensor) -> Tensor:
    """(N,) 3D IoU of matching rows, float64."""
    if len(a) != len(b):
        raise ValueError(f"boxes_a and boxes_b: expected as many boxes in both, got {len(a)} and {len(b)}")
    return _volume_iou(a, b)
