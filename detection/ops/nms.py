"""Non-maximum suppression of boxes seen from above, rotated or by their unrotated rectangles (numpy and numba)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from detection.ops._numba import kernel
from detection.ops.rotated_iou import bev_iou, checked_boxes, is_tensor

if TYPE_CHECKING:
    from torch import Tensor

Array = NDArray[np.float64]


@kernel
def _aligned_iou(box_a: Array, box_b: Array) -> float:
    """Intersection over union of the rectangles x -+ l/2, z -+ w/2, as if ry were 0."""
    shared_x = min(box_a[0] + box_a[5] / 2, box_b[0] + box_b[5] / 2) - max(
        box_a[0] - box_a[5] / 2, box_b[0] - box_b[5] / 2
    )
    shared_z = min(box_a[2] + box_a[4] / 2, box_b[2] + box_b[4] / 2) - max(
        box_a[2] - box_a[4] / 2, box_b[2] - box_b[4] / 2
    )
    if shared_x <= 0.0 or shared_z <= 0.0:
        return 0.0
    shared = shared_x * shared_z
    return shared / (box_a[4] * box_a[5] + box_b[4] * box_b[5] - shared)


@kernel
def _keep_rotated(boxes: Array, threshold: float, keep: Any) -> int:
    """Go through boxes from the best score on; write the rows that survive to `keep` until it is full."""
    kept = 0
    for candidate in range(boxes.shape[0]):
        if kept == keep.size:
            break
        survives = True
        for k in range(kept):
            if bev_iou(boxes[keep[k]], boxes[candidate]) > threshold:
                survives = False
                break
        if survives:
            keep[kept] = candidate
            kept += 1
    return kept


@kernel
def _keep_aligned(boxes: Array, threshold: float, keep: Any) -> int:
    """As `_keep_rotated` with unrotated rectangles."""
    kept = 0
    for candidate in range(boxes.shape[0]):
        if kept == keep.size:
            break
        survives = True
        for k in range(kept):
            if _aligned_iou(boxes[keep[k]], boxes[candidate]) > threshold:
                survives = False
                break
        if survives:
            keep[kept] = candidate
            kept += 1
    return kept


def _suppress(keep_kernel: Any, boxes: Any, scores: Any, threshold: float, limit: int | None) -> Any:
    if is_tensor(boxes):
        # Thousands of boxes are a small copy; the search itself is sequential on every device.
        device = boxes.device
        kept = _suppress(keep_kernel, boxes.detach().cpu().numpy(), scores.detach().cpu().numpy(), threshold, limit)
        import torch

        return torch.from_numpy(kept).to(device)
    values, ranks = checked_boxes(boxes, "boxes"), np.asarray(scores, dtype=np.float64)
    if ranks.shape != (len(values),) or np.isnan(ranks).any():
        raise ValueError(f"scores: expected ({len(values)},) numbers, one per box, got shape {ranks.shape} or NaN")
    if limit is not None and limit < 0:
        raise ValueError(f"limit: expected None or at least 0, got {limit}")
    order = np.argsort(-ranks, kind="stable")
    keep = np.zeros(len(values) if limit is None else min(limit, len(values)), np.int64)
    count = keep_kernel(values[order], float(threshold), keep)
    return order[keep[:count]]


@overload
def nms_rotated(
    boxes: NDArray[Any], scores: NDArray[Any], threshold: float, limit: int | None = None
) -> NDArray[np.int64]: ...
@overload
def nms_rotated(boxes: Tensor, scores: Tensor, threshold: float, limit: int | None = None) -> Tensor: ...
def nms_rotated(boxes: Any, scores: Any, threshold: float, limit: int | None = None) -> Any:
    """Boxes that overlap no better box by more than `threshold` of rotated bird's-eye IoU.

    boxes      (N, 7) x y z h w l ry, camera form; numpy or a tensor of any device
    scores     (N,); equal scores are taken in index order
    threshold  a box is dropped when its IoU with a kept one is *greater* than this
    limit      keep at most this many, which ends the search early; None for all
    Returns (K,) int64 indices into `boxes`, best score first, of the kind and device of `boxes`.
    Raises ValueError for other shapes, boxes that are not finite, or NaN scores.
    """
    return _suppress(_keep_rotated, boxes, scores, threshold, limit)


@overload
def nms_axis_aligned(
    boxes: NDArray[Any], scores: NDArray[Any], threshold: float, limit: int | None = None
) -> NDArray[np.int64]: ...
@overload
def nms_axis_aligned(boxes: Tensor, scores: Tensor, threshold: float, limit: int | None = None) -> Tensor: ...
def nms_axis_aligned(boxes: Any, scores: Any, threshold: float, limit: int | None = None) -> Any:
    """As `nms_rotated`, but the overlap ignores ry: every box is the rectangle with l along x and w along z.

    This is the "normal" NMS that PointRCNN and EPNet run on their proposals.
    """
    return _suppress(_keep_aligned, boxes, scores, threshold, limit)
