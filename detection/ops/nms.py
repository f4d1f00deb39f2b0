"""Non-maximum suppression of boxes seen from above, rotated or by their unrotated rectangles (numpy and numba)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from detection.ops.rotated_iou import checked_boxes, is_tensor, keep_aligned, keep_rotated

if TYPE_CHECKING:
    from torch import Tensor


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
    return _suppress(keep_rotated, boxes, scores, threshold, limit)


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
    return _suppress(keep_aligned, boxes, scores, threshold, limit)
