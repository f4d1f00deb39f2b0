"""Boxes of the LiDAR-frame detectors: x y z (geometric centre) l w h heading, heading counter-clockwise from +x."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from detection.models.box_coding import decode_residual, encode_residual
from detection.models.openpcdet_pointrcnn import rotate_z, to_camera_axes

__all__ = [
    "limit_period",
    "nearest_bev_iou",
    "refined_boxes",
    "residual_targets",
    "roi_grid_points",
    "rotate_z",
    "to_camera_axes",
    "to_lidar_axes",
]


def to_lidar_axes(boxes: Tensor) -> Tensor:
    """Inverse of `to_camera_axes`: (..., 7) x y z(bottom) h w l ry in turned axes -> LiDAR form."""
    x, y, z, h, w, l, ry = boxes.unbind(-1)
    return torch.stack([z, -x, h / 2 - y, l, w, h, -ry - math.pi / 2], dim=-1)


def limit_period(angle: Tensor, offset: float, period: float) -> Tensor:
    """`angle` shifted by whole periods into [-offset * period, (1 - offset) * period)."""
    return angle - (angle / period + offset).floor() * period


def _aligned_rectangles(boxes: Tensor) -> Tensor:
    """(N, 7) -> (N, 4) x1 y1 x2 y2 of each box turned to the nearest multiple of 90 degrees."""
    along = limit_period(boxes[:, 6], 0.5, math.pi).abs() < math.pi / 4
    half = torch.where(along[:, None], boxes[:, 3:5], boxes[:, [4, 3]]) / 2
    return torch.cat([boxes[:, :2] - half, boxes[:, :2] + half], dim=1)


def nearest_bev_iou(boxes_a: Tensor, boxes_b: Tensor) -> Tensor:
    """(N, M) IoU from above of boxes turned to the nearest axis: what anchors are matched by (SECOND)."""
    a, b = _aligned_rectangles(boxes_a)[:, None], _aligned_rectangles(boxes_b)[None]
    shared = (torch.minimum(a[..., 2:], b[..., 2:]) - torch.maximum(a[..., :2], b[..., :2])).clamp(min=0).prod(dim=-1)
    areas = (a[..., 2:] - a[..., :2]).prod(dim=-1) + (b[..., 2:] - b[..., :2]).prod(dim=-1)
    return shared / (areas - shared).clamp(min=1e-6)


def roi_grid_points(rois: Tensor, size: int) -> Tensor:
    """(R, size^3, 3) points of a regular grid in each RoI (R, 7), x outermost and z innermost."""
    steps = (torch.arange(size, device=rois.device, dtype=rois.dtype) + 0.5) / size - 0.5
    cells = torch.cartesian_prod(steps, steps, steps)
    return rotate_z(cells * rois[:, None, 3:6], rois[:, None, 6]) + rois[:, None, :3]


def _own_anchors(rois: Tensor) -> Tensor:
    """RoIs (..., 7) in their own frames: only their sizes remain."""
    zeros = torch.zeros_like(rois)
    return torch.cat([zeros[..., :3], rois[..., 3:6], zeros[..., 6:]], dim=-1)


def refined_boxes(rois: Tensor, code: Tensor) -> Tensor:
    """(..., 7) RoIs and codes relative to them -> (..., 7) boxes."""
    local = decode_residual(code, _own_anchors(rois))
    centre = rotate_z(local[..., :3], rois[..., 6]) + rois[..., :3]
    return torch.cat([centre, local[..., 3:6], local[..., 6:] + rois[..., 6:]], dim=-1)


def residual_targets(rois: Tensor, truth: Tensor) -> Tensor:
    """(R, 7) codes that take RoIs to the truth; the turn is folded to +-90 degrees (a box is its own turn by pi)."""
    centre = rotate_z(truth[:, :3] - rois[:, :3], -rois[:, 6])
    turn = limit_period(truth[:, 6] - rois[:, 6], 0.5, math.pi)
    return encode_residual(torch.cat([centre, truth[:, 3:6], turn[:, None]], dim=1), _own_anchors(rois))
