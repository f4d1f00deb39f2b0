"""The point operations in plain torch, for devices that numba does not reach and as a cross-check of the kernels.

Every function takes checked batches (see `_tensors`) and returns exactly what the kernel of the same name returns:
squared distances are (dx*dx + dy*dy) + dz*dz in float32, never a matrix product, which loses a millimetre at 70 m.
"""

from __future__ import annotations

import torch
from torch import Tensor

_PAIRS = 1 << 24  # distances held at a time: 64 MB per float32 temporary


def _squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """(B, P, N) between a (B, P, 3) and b (B, N, 3)."""
    dx, dy, dz = (a[:, :, None, axis] - b[:, None, :, axis] for axis in range(3))
    return (dx * dx + dy * dy) + dz * dz


def _chunk(batch: int, width: int) -> int:
    return max(1, _PAIRS // max(batch * width, 1))


def furthest_point_sample(xyz: Tensor, npoint: int) -> Tensor:
    """(B, npoint) int64."""
    batch, count, _ = xyz.shape
    lanes = torch.arange(count, device=xyz.device)
    rows = torch.arange(batch, device=xyz.device)
    remaining = xyz.new_full((batch, count), 1e10)
    chosen = torch.zeros(batch, dtype=torch.int64, device=xyz.device)
    samples = torch.zeros(batch, npoint, dtype=torch.int64, device=xyz.device)
    for k in range(npoint):
        samples[:, k] = chosen
        remaining = torch.minimum(remaining, _squared_distances(xyz[rows, chosen][:, None], xyz)[:, 0])
        # argmax does not promise the first maximum on every device.
        furthest = remaining == remaining.amax(dim=1, keepdim=True)
        chosen = torch.where(furthest, lanes, count).amin(dim=1)
    return samples


def ball_query(xyz: Tensor, centres: Tensor, radius2: float, nsample: int) -> Tensor:
    """(B, P, nsample) int64."""
    batch, count, _ = xyz.shape
    lanes = torch.arange(count, device=xyz.device)
    kept = min(nsample, count)
    parts = []
    for part in centres.split(_chunk(batch, count), dim=1):
        keys = torch.where(_squared_distances(part, xyz) < radius2, lanes, count)
        lowest = keys.topk(kept, dim=-1, largest=False, sorted=True).values
        first = lowest[..., :1] % count  # "none found" is index 0
        lowest = torch.where(lowest < count, lowest, first)
        parts.append(torch.cat([lowest, first.expand(*first.shape[:2], nsample - kept)], dim=-1))
    return torch.cat(parts, dim=1) if parts else xyz.new_zeros((batch, 0, nsample), dtype=torch.int64)


def three_nn(unknown: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Squared distances and indices, (B, N, 3) float32 and int64."""
    batch, count, _ = known.shape
    lanes = torch.arange(count, device=known.device)
    distances = unknown.new_full(unknown.shape, torch.inf)
    indices = torch.zeros(unknown.shape, dtype=torch.int64, device=unknown.device)
    step = _chunk(batch, count)
    for start in range(0, unknown.shape[1], step):
        rows = slice(start, start + step)
        remaining = _squared_distances(unknown[:, rows], known)
        for k in range(min(3, count)):  # three minima rather than topk, which leaves the order of ties open
            smallest = remaining.amin(dim=-1, keepdim=True)
            nearest = torch.where(remaining == smallest, lanes, count).amin(dim=-1, keepdim=True)
            distances[:, rows, k], indices[:, rows, k] = smallest[..., 0], nearest[..., 0]
            remaining.scatter_(-1, nearest, torch.inf)
    return distances, indices


def in_boxes(points: Tensor, boxes: Tensor, near: float) -> Tensor:
    """(B, M, N) bool; boxes (B, M, 8) hold cos ry and sin ry in the last two columns."""
    half_h, half_w, half_l = (boxes[..., column, None] / 2 for column in (3, 4, 5))
    dx = points[:, None, :, 0] - boxes[..., 0, None]
    dy = points[:, None, :, 1] - (boxes[..., 1, None] - half_h)
    dz = points[:, None, :, 2] - boxes[..., 2, None]
    cos, sin = boxes[..., 6, None], boxes[..., 7, None]
    along, across = dx * cos - dz * sin, dx * sin + dz * cos
    reached = (dx.abs() <= near) & (dz.abs() <= near) & (dy.abs() <= half_h)
    return reached & (along.abs() <= half_l) & (across.abs() <= half_w)


def first_in_boxes(points: Tensor, boxes: Tensor, near: float, nsample: int) -> tuple[Tensor, Tensor]:
    """(B, M, nsample) int64 and empty (B, M) bool."""
    batch, count, _ = points.shape
    lanes = torch.arange(count, device=points.device)
    slots = torch.arange(nsample, device=points.device)
    indices, empties = [], []
    for part in boxes.split(_chunk(batch, count), dim=1):
        inside = in_boxes(points, part, near)
        found = inside.sum(dim=-1).clamp(max=nsample)
        lowest = torch.where(inside, lanes, count).topk(min(nsample, count), dim=-1, largest=False, sorted=True).values
        cycle = slots % found.clamp(min=1)[..., None]
        index = lowest.gather(-1, cycle)
        indices.append(torch.where(found[..., None] > 0, index, 0))
        empties.append(found == 0)
    if not indices:
        return boxes.new_zeros((batch, 0, nsample), dtype=torch.int64), boxes.new_zeros((batch, 0), dtype=torch.bool)
    return torch.cat(indices, dim=1), torch.cat(empties, dim=1)
