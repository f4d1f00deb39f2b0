"""How good Frustum PointNet is on held-out frustums while it is trained."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from detection.frustum.infer import decode
from detection.frustum.network import FrustumPointNet
from detection.frustum.samples import FrustumSample, collate
from detection.ops import iou_3d_aligned

_AT_ONCE = 32


def frustum_figures(
    model: FrustumPointNet, samples: Sequence[FrustumSample], points: int, device: torch.device
) -> dict[str, float]:
    """segmentation: share of points told right; iou_3d: mean; found_0.7: share of boxes of IoU 0.7 and more.

    The draws are the same every time; the network is left in evaluation mode.
    """
    model.eval()
    rng = np.random.default_rng(0)
    right: list[NDArray[np.bool_]] = []
    ious: list[NDArray[np.float64]] = []
    for first in range(0, len(samples), _AT_ONCE):
        some = samples[first : first + _AT_ONCE]
        batch = collate(some, points, rng, device)
        with torch.inference_mode():
            output = model(batch.points, batch.one_hot, rng)
        right.append((output.mask.cpu() == (batch.targets.mask.cpu() > 0)).numpy().reshape(-1))
        boxes = decode(output)
        found = _rows(boxes.centre, boxes.size, boxes.heading)
        truth = _rows(*(np.array([getattr(s, name) for s in some]) for name in ("centre", "size", "heading")))
        ious.append(iou_3d_aligned(found, truth))
    overlap = np.concatenate(ious)
    return {
        "segmentation": float(np.concatenate(right).mean()),
        "iou_3d": float(overlap.mean()),
        "found_0.7": float((overlap >= 0.7).mean()),
    }


def _rows(centre: NDArray[np.float64], size: NDArray[np.float64], heading: NDArray[np.float64]) -> NDArray[np.float64]:
    """(B, 7) x y z (bottom) h w l ry of boxes given by geometric centre and l w h."""
    length, width, height = np.maximum(size, 0.01).T
    x, y, z = centre.T
    return np.column_stack([x, y + height / 2, z, height, width, length, heading])
