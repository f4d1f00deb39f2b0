"""What the losses and errors mean: expected losses, error maps, regions, distances, sharpness of boundaries."""

from __future__ import annotations

import numpy as np

from completion.types import FloatMap


def mixed_share(
    prediction: FloatMap, target: FloatMap, window: int = 7, margin: float = 0.5, step: float = 2.0
) -> float:
    """Share of mixed depths at the depth edges of a target: between two surfaces, and measured by neither.

    A pixel is at an edge when the largest gap between the sorted valid target depths of its window exceeds `step`
    metres and 10 % of the near side f (far side b). It is mixed when f + margin < prediction < b - margin and the
    prediction is more than `margin` metres from every valid target in the window. Predictions of 0 do not count.
    Returns a share in [0, 1]; NaN when there is no edge. For a dense or semi-dense target (H, W).
    """
    half = window // 2
    height, width = target.shape
    span = np.zeros(target.shape, bool)
    rows, columns = np.nonzero(_edge_candidates(target, window, step, span) & (prediction > 0))
    padded = np.pad(target, half)
    values = np.stack([padded[rows + i, columns + j] for i in range(window) for j in range(window)], 1)
    order = np.sort(np.where(values > 0, values, np.inf), 1)
    gaps = np.diff(np.where(np.isfinite(order), order, np.nan), axis=1)
    gaps = np.where(np.isfinite(gaps), gaps, 0)
    widest = gaps.argmax(1)
    lines = np.arange(len(rows))
    near, far = order[lines, widest], order[lines, np.minimum(widest + 1, order.shape[1] - 1)]
    edge = (far - near > np.maximum(step, 0.1 * near)) & np.isfinite(far)
    if not edge.any():
        return float("nan")
    found = prediction[rows, columns]
    distance = np.abs(np.where(values > 0, values, np.inf) - found[:, None]).min(1)
    mixed = (found > near + margin) & (found < far - margin) & (distance > margin)
    return float(mixed[edge].mean())


def _edge_candidates(target: FloatMap, window: int, step: float, span: np.ndarray) -> np.ndarray:
    """Pixels whose window spans more than `step`: a fast superset of the edges."""
    import cv2

    kernel = np.ones((window, window), np.uint8)
    largest = cv2.dilate(target, kernel)
    smallest = cv2.erode(np.where(target > 0, target, np.float32(1e6)), kernel)
    return largest - smallest > step
