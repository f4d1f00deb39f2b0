"""Point and box operations: one public function each, numba on the CPU, torch on any device.

Names are loaded when first used, so that the evaluator (numpy and numba) never imports torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from detection.ops.grouping import ball_query as ball_query
    from detection.ops.grouping import group_points as group_points
    from detection.ops.interpolation import interpolation_weights as interpolation_weights
    from detection.ops.interpolation import three_interpolate as three_interpolate
    from detection.ops.interpolation import three_nn as three_nn
    from detection.ops.nms import nms_axis_aligned as nms_axis_aligned
    from detection.ops.nms import nms_rotated as nms_rotated
    from detection.ops.pooling import points_in_boxes as points_in_boxes
    from detection.ops.pooling import roi_pool as roi_pool
    from detection.ops.rotated_iou import iou_3d as iou_3d
    from detection.ops.rotated_iou import iou_3d_aligned as iou_3d_aligned
    from detection.ops.rotated_iou import iou_bev as iou_bev
    from detection.ops.sampling import furthest_point_sample as furthest_point_sample

_MODULES = {
    "ball_query": "grouping",
    "furthest_point_sample": "sampling",
    "group_points": "grouping",
    "interpolation_weights": "interpolation",
    "iou_3d": "rotated_iou",
    "iou_3d_aligned": "rotated_iou",
    "iou_bev": "rotated_iou",
    "nms_axis_aligned": "nms",
    "nms_rotated": "nms",
    "points_in_boxes": "pooling",
    "roi_pool": "pooling",
    "three_interpolate": "interpolation",
    "three_nn": "interpolation",
}

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_MODULES])
