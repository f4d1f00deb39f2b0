"""Point and box operations: one public function each, numba on the CPU, torch on any device.

Names are loaded when first used, so that the evaluator (numpy and numba) never imports torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from detection.ops.rotated_iou import iou_3d as iou_3d
    from detection.ops.rotated_iou import iou_3d_aligned as iou_3d_aligned
    from detection.ops.rotated_iou import iou_bev as iou_bev

_MODULES = {
    "iou_3d": "rotated_iou",
    "iou_3d_aligned": "rotated_iou",
    "iou_bev": "rotated_iou",
}

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_MODULES])
