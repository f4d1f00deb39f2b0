"""The tensor side of `pooling`: kernels on the CPU, torch elsewhere."""

from __future__ import annotations

import torch
from torch import Tensor

from detection.ops import _torch_points
from detection.ops._tensors import as_batch, check_same_batch, coordinates, positive, unbatched

_REGIONS = 32  # fewer are not worth another thread


def _turned(boxes: Tensor) -> Tensor:
    """(..., 8): ry of boxes (..., 7) replaced by its cosine and sine."""
    return torch.cat([boxes[..., :6], boxes[..., 6:].cos(), boxes[..., 6:].sin()], dim=-1).contiguous()


def points_in_boxes(points: Tensor, boxes: Tensor) -> Tensor:
    """(B, M, N) or (M, N) bool."""
    places, single = as_batch(points.detach(), "points", "3", 3)
    values, _ = as_batch(boxes.detach(), "boxes", "7", 7)
    check_same_batch(places, "points", values, "boxes")
    if places.dtype not in (torch.float32, torch.float64):
        places = places.float()
    turned = _turned(values.to(places.dtype))
    if places.device.type != "cpu":
        return unbatched(_torch_points.in_boxes(places, turned, torch.inf), single)

    from detection.ops import _roi_kernels

    inside = torch.zeros(*turned.shape[:2], places.shape[1], dtype=torch.uint8)
    source = places.contiguous().numpy()
    _roi_kernels.in_boxes(source, turned.numpy(), source.dtype.type("inf"), inside.numpy())
    return unbatched(inside.view(torch.bool), single)


def enlarged(boxes: Tensor, extra_width: float) -> Tensor:
    """Boxes (..., 7) grown by `extra_width` metres on every side; the bottom centre sinks (y points down)."""
    values = boxes.clone()
    values[..., 3:6] += 2 * extra_width
    values[..., 1] += extra_width
    return values


def _first_in_boxes(points: Tensor, boxes: Tensor, near: float, nsample: int) -> tuple[Tensor, Tensor]:
    """(B, M, nsample) int64 and empty (B, M) bool."""
    if points.device.type != "cpu":
        return _torch_points.first_in_boxes(points, boxes, near, nsample)

    from detection.ops import _roi_kernels
    from detection.ops._numba import for_blocks

    index = torch.zeros(*boxes.shape[:2], nsample, dtype=torch.int64)
    empty = torch.zeros(boxes.shape[:2], dtype=torch.uint8)
    source, regions, slots, flags = points.numpy(), boxes.numpy(), index.numpy(), empty.numpy()
    limit = source.dtype.type(near)

    def search(b: slice, m: slice) -> None:
        _roi_kernels.first_in_boxes(source[b], regions[b, m], limit, slots[b, m], flags[b, m])

    for_blocks(search, (regions.shape[0], regions.shape[1]), torch.get_num_threads(), _REGIONS)
    return index, empty.view(torch.bool)


@torch.no_grad()
def roi_pool(
    points: Tensor, features: Tensor, rois: Tensor, extra_width: float, nsample: int, near: float
) -> tuple[Tensor, Tensor]:
    """See `detection.ops.roi_pool`."""
    places, single = coordinates(points, "points")
    values, _ = as_batch(features, "features", "C", None)
    regions, _ = as_batch(rois, "rois", "7", 7)
    check_same_batch(places, "points", values, "features")
    check_same_batch(places, "points", regions, "rois")
    nsample = positive(nsample, "nsample")
    batch, count, channels = values.shape
    if count != places.shape[1]:
        raise ValueError(f"features: expected one row per point, got {count} rows for {places.shape[1]} points")
    if count == 0:
        pooled = values.new_zeros(batch, regions.shape[1], nsample, 3 + channels)
        return unbatched(pooled, single), unbatched(pooled.new_ones(regions.shape[:2], dtype=torch.bool), single)

    index, empty = _first_in_boxes(places, _turned(enlarged(regions.float(), extra_width)), near, nsample)
    rows = torch.cat([torch.as_tensor(points).view(batch, count, 3).to(values.dtype), values], dim=-1)
    offsets = (torch.arange(batch, device=index.device) * count).view(-1, 1, 1)
    pooled = rows.view(batch * count, 3 + channels).index_select(0, (index + offsets).view(-1))
    pooled = pooled.view(batch, -1, nsample, 3 + channels)
    pooled[empty] = 0.0
    return unbatched(pooled, single), unbatched(empty, single)
