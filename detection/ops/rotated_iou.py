"""Overlap of rotated boxes from above and in 3D, in float64 (numba for numpy and CPU tensors, torch elsewhere).

Boxes are in camera form: x y z of the bottom centre, h w l, ry. The bird's-eye rectangle lies in the x-z plane, l along
the box's own x. This module imports numpy and numba only; torch is imported when a tensor comes in.

The intersection is found without a list of vertices. Seen from box a, box b is a convex quadrilateral and a is the
axis-aligned rectangle |x| <= l/2, |z| <= w/2. Moving every point of b's outline to the nearest point of that rectangle
squeezes what lies outside flat, so the area within the moved outline is the area of the intersection. By Green's
theorem that is the integral of x dz along it: per edge a clip in z and the mean of a clamped straight line. Nothing in
it is ill-conditioned: touching, identical and contained boxes need no special case.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from detection.ops._numba import kernel
from detection.ops._rounding import RESIDUE

if TYPE_CHECKING:
    from torch import Tensor

Array = NDArray[np.float64]


@kernel
def _clamped_mean(xa: float, xb: float, limit: float) -> float:
    """Mean of clamp(x, -limit, limit) while x runs straight from xa to xb."""
    low, high = min(xa, xb), max(xa, xb)
    if low >= -limit and high <= limit:
        return 0.5 * (low + high)
    if low >= limit:
        return limit
    if high <= -limit:
        return -limit
    below = max(-limit - low, 0.0) / (high - low)
    above = max(high - limit, 0.0) / (high - low)
    middle = 0.5 * (max(low, -limit) + min(high, limit))
    return limit * (above - below) + middle * (1.0 - above - below)


@kernel
def _edge_integral(x0: float, z0: float, x1: float, z1: float, half_l: float, half_w: float) -> float:
    """Integral of x dz along one edge after moving it into the rectangle |x| <= half_l, |z| <= half_w."""
    za, zb = min(max(z0, -half_w), half_w), min(max(z1, -half_w), half_w)
    if za == zb:
        return 0.0
    slope = (x1 - x0) / (z1 - z0)
    xa = x0 + (za - z0) * slope
    xb = x1 + (zb - z1) * slope
    return _clamped_mean(xa, xb, half_l) * (zb - za)


@kernel
def bev_intersection(box_a: Array, box_b: Array) -> float:
    """Area in m^2 of the intersection of two boxes (7,) seen from above; 0 for boxes without positive l and w."""
    half_la, half_wa, half_lb, half_wb = 0.5 * box_a[5], 0.5 * box_a[4], 0.5 * box_b[5], 0.5 * box_b[4]
    if half_la <= 0.0 or half_wa <= 0.0 or half_lb <= 0.0 or half_wb <= 0.0:
        return 0.0
    dx, dz = box_b[0] - box_a[0], box_b[2] - box_a[2]
    reach = np.sqrt(half_la * half_la + half_wa * half_wa) + np.sqrt(half_lb * half_lb + half_wb * half_wb)
    if dx * dx + dz * dz >= reach * reach:
        return 0.0
    # Box b in the frame of a: its centre and its two half axes.
    cos_a, sin_a = np.cos(box_a[6]), np.sin(box_a[6])
    x, z = dx * cos_a - dz * sin_a, dx * sin_a + dz * cos_a
    turn = box_b[6] - box_a[6]
    cos, sin = np.cos(turn), np.sin(turn)
    lx, lz, wx, wz = half_lb * cos, -half_lb * sin, half_wb * sin, half_wb * cos
    x0, z0 = x + lx + wx, z + lz + wz
    x1, z1 = x - lx + wx, z - lz + wz
    x2, z2 = x - lx - wx, z - lz - wz
    x3, z3 = x + lx - wx, z + lz - wz
    area = _edge_integral(x0, z0, x1, z1, half_la, half_wa)
    area += _edge_integral(x1, z1, x2, z2, half_la, half_wa)
    area += _edge_integral(x2, z2, x3, z3, half_la, half_wa)
    area += _edge_integral(x3, z3, x0, z0, half_la, half_wa)
    return area if area > RESIDUE * (half_la * half_wa + half_lb * half_wb) else 0.0


@kernel
def bev_iou(box_a: Array, box_b: Array) -> float:
    """Intersection over union of two boxes (7,) seen from above."""
    shared = bev_intersection(box_a, box_b)
    if shared <= 0.0:
        return 0.0
    return min(shared / (box_a[4] * box_a[5] + box_b[4] * box_b[5] - shared), 1.0)


@kernel
def volume_iou(box_a: Array, box_b: Array) -> float:
    """Intersection over union of two boxes (7,) in 3D; a box spans y - h ... y (y points down)."""
    height = min(box_a[1], box_b[1]) - max(box_a[1] - box_a[3], box_b[1] - box_b[3])
    if height <= 0.0:
        return 0.0
    shared = bev_intersection(box_a, box_b) * height
    if shared <= 0.0:
        return 0.0
    volumes = box_a[3] * box_a[4] * box_a[5] + box_b[3] * box_b[4] * box_b[5]
    return min(shared / (volumes - shared), 1.0)


@kernel
def _bev_matrix(boxes_a: Array, boxes_b: Array, out: Array) -> None:
    for i in range(boxes_a.shape[0]):
        for j in range(boxes_b.shape[0]):
            out[i, j] = bev_iou(boxes_a[i], boxes_b[j])


@kernel
def _volume_matrix(boxes_a: Array, boxes_b: Array, out: Array) -> None:
    for i in range(boxes_a.shape[0]):
        for j in range(boxes_b.shape[0]):
            out[i, j] = volume_iou(boxes_a[i], boxes_b[j])


@kernel
def _volume_rows(boxes_a: Array, boxes_b: Array, out: Array) -> None:
    for i in range(boxes_a.shape[0]):
        out[i] = volume_iou(boxes_a[i], boxes_b[i])


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
def keep_rotated(boxes: Array, threshold: float, keep: Any) -> int:
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
def keep_aligned(boxes: Array, threshold: float, keep: Any) -> int:
    """As `keep_rotated` with unrotated rectangles."""
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


def checked_boxes(boxes: Any, name: str) -> Array:
    """`boxes` as C-contiguous (N, 7) float64; an empty list counts as (0, 7). Raises ValueError otherwise."""
    values = np.ascontiguousarray(boxes, dtype=np.float64)
    if values.size == 0 and values.ndim <= 2:
        return values.reshape(0, 7)
    if values.ndim != 2 or values.shape[1] != 7:
        raise ValueError(f"{name}: expected (N, 7) boxes x y z h w l ry, got shape {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: {int((~np.isfinite(values)).any(axis=1).sum())} boxes hold NaN or infinite values")
    return values


def is_tensor(values: Any) -> bool:
    """Whether `values` is a torch tensor, found without importing torch."""
    return type(values).__module__.split(".")[0] == "torch"


@overload
def iou_bev(boxes_a: NDArray[Any], boxes_b: NDArray[Any]) -> Array: ...
@overload
def iou_bev(boxes_a: Tensor, boxes_b: Tensor) -> Tensor: ...
def iou_bev(boxes_a: Any, boxes_b: Any) -> Any:
    """(N, M) intersection over union of rotated boxes seen from above (x-z plane, camera frame).

    boxes_a  (N, 7) x y z h w l ry; metres, radians
    boxes_b  (M, 7)
    Numpy in, float64 out; tensors in, a tensor of boxes_a's dtype on its device out. The arithmetic is float64 in both.
    Boxes without positive extent overlap nothing. Raises ValueError for other shapes or values that are not finite.
    """
    if is_tensor(boxes_a):
        from detection.ops import _rotated_iou_torch

        return _rotated_iou_torch.on_device(iou_bev, _rotated_iou_torch.iou_bev_torch, boxes_a, boxes_b)
    a, b = checked_boxes(boxes_a, "boxes_a"), checked_boxes(boxes_b, "boxes_b")
    out = np.zeros((len(a), len(b)))
    _bev_matrix(a, b, out)
    return out


@overload
def iou_3d(boxes_a: NDArray[Any], boxes_b: NDArray[Any]) -> Array: ...
@overload
def iou_3d(boxes_a: Tensor, boxes_b: Tensor) -> Tensor: ...
def iou_3d(boxes_a: Any, boxes_b: Any) -> Any:
    """(N, M) intersection over union of rotated boxes in 3D: shared area from above times shared height.

    Arguments, results and errors as `iou_bev`; a box spans y - h ... y.
    """
    if is_tensor(boxes_a):
        from detection.ops import _rotated_iou_torch

        return _rotated_iou_torch.on_device(iou_3d, _rotated_iou_torch.iou_3d_torch, boxes_a, boxes_b)
    a, b = checked_boxes(boxes_a, "boxes_a"), checked_boxes(boxes_b, "boxes_b")
    out = np.zeros((len(a), len(b)))
    _volume_matrix(a, b, out)
    return out


@overload
def iou_3d_aligned(boxes_a: NDArray[Any], boxes_b: NDArray[Any]) -> Array: ...
@overload
def iou_3d_aligned(boxes_a: Tensor, boxes_b: Tensor) -> Tensor: ...
def iou_3d_aligned(boxes_a: Any, boxes_b: Any) -> Any:
    """(N,) 3D intersection over union of matching rows of boxes_a (N, 7) and boxes_b (N, 7); otherwise as `iou_3d`."""
    if is_tensor(boxes_a):
        from detection.ops import _rotated_iou_torch

        return _rotated_iou_torch.on_device(iou_3d_aligned, _rotated_iou_torch.iou_3d_aligned_torch, boxes_a, boxes_b)
    a, b = checked_boxes(boxes_a, "boxes_a"), checked_boxes(boxes_b, "boxes_b")
    if len(a) != len(b):
        raise ValueError(f"boxes_a and boxes_b: expected as many boxes in both, got {len(a)} and {len(b)}")
    out = np.zeros(len(a))
    _volume_rows(a, b, out)
    return out
