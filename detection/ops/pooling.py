"""Points inside boxes, and the pooling of points and features per region of interest."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from detection.ops.rotated_iou import checked_boxes, is_tensor

if TYPE_CHECKING:
    from torch import Tensor

_NEAR = 10.0  # metres: the reference kernel drops points farther than this from the RoI's centre in x or in z


@overload
def points_in_boxes(points: NDArray[Any], boxes: NDArray[Any]) -> NDArray[np.bool_]: ...
@overload
def points_in_boxes(points: Tensor, boxes: Tensor) -> Tensor: ...
def points_in_boxes(points: Any, boxes: Any) -> Any:
    """Which points lie in which rotated boxes, faces included.

    points  (N, 3) metres, camera frame; tensors may be batched, (B, N, 3)
    boxes   (M, 7) x y z of the bottom centre, h w l, ry; tensors (B, M, 7) with the points
    Returns (M, N) bool, for batched tensors (B, M, N). The arithmetic has the dtype of `points`.
    Raises ValueError for other shapes.
    """
    if is_tensor(points):
        from detection.ops import _pooling_torch

        return _pooling_torch.points_in_boxes(points, boxes)
    from detection.ops import _roi_kernels

    places = np.ascontiguousarray(points)
    if places.ndim != 2 or places.shape[1] != 3 or places.dtype not in (np.float32, np.float64):
        raise ValueError(f"points: expected (N, 3) float32 or float64, got {places.dtype} of shape {places.shape}")
    values = checked_boxes(boxes, "boxes").astype(places.dtype)
    turned = np.concatenate([values[:, :6], np.cos(values[:, 6:]), np.sin(values[:, 6:])], axis=1)
    inside = np.zeros((1, len(values), len(places)), np.uint8)
    _roi_kernels.in_boxes(places[None], turned[None], places.dtype.type(np.inf), inside)
    return inside[0].view(np.bool_)


def roi_pool(points: Tensor, features: Tensor, rois: Tensor, extra_width: float, nsample: int) -> tuple[Tensor, Tensor]:
    """The first `nsample` points, in index order, inside each enlarged RoI, with their features (PointRCNN, 2019).

    points       (B, N, 3) or (N, 3), metres, rectified camera frame, any device
    features     (B, N, C) or (N, C)
    rois         (B, M, 7) or (M, 7) x y z of the bottom centre, h w l, ry
    extra_width  metres added on *every* side: h, w and l grow by twice as much and the bottom sinks by it
    Returns pooled (B, M, nsample, 3 + C): coordinates in the scene frame, then features; and empty (B, M) bool.
    With fewer points than slots they repeat in a cycle (slot k holds point k mod count); an empty RoI holds zeros.
    As in the reference, points beyond 10 m of the RoI's centre in x or z never count, the test is float32, and no
    gradient flows: the second stage does not train the first one's features.
    Raises ValueError for other shapes.
    """
    from detection.ops import _pooling_torch

    return _pooling_torch.roi_pool(points, features, rois, extra_width, nsample, _NEAR)
