"""What losses and errors mean: expected losses, relative error maps, regions, distances, sharpness of boundaries."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from completion.metrics import depth_metrics
from completion.types import FloatMap

Mask = NDArray[np.bool_]


def expected_loss(
    loss: Callable[[Any], Any], estimate: Any, depths: Sequence[float], probabilities: Sequence[float]
) -> Any:
    """E{L(d)} = sum_i p_i L(d - d_i) at every estimate d (Eq. 4.1); arrays or tensors. ValueError unless sum p = 1."""
    if len(depths) != len(probabilities) or abs(sum(probabilities) - 1) > 1e-9:
        raise ValueError(f"expected one probability per depth, summing to 1, got {probabilities} for {depths}")
    return sum(p * loss(estimate - d) for d, p in zip(depths, probabilities))


def smallest_gamma(foreground_probability: float) -> float:
    """Gamma above which the expected ALE of a binary ambiguity is least at the foreground: sqrt(p2 / p1) (Eq. 4.4)."""
    if not 0 < foreground_probability < 1:
        raise ValueError(f"probability: expected a value in (0, 1), got {foreground_probability}")
    return float(np.sqrt((1 - foreground_probability) / foreground_probability))


def expected_fusion_loss(sigma: Any, foreground: float, background: float, probability: float) -> Any:
    """L_e(sigma) = p |f - d1| + (1 - p) |f - d2| with f = sigma d1 + (1 - sigma) d2 (Eq. 4.6, 4.7)."""
    fused = sigma * foreground + (1 - sigma) * background
    return probability * abs(fused - foreground) + (1 - probability) * abs(fused - background)


def relative_error_maps(baseline: FloatMap, ours: FloatMap, target: FloatMap) -> tuple[FloatMap, FloatMap]:
    """A = |d_M - d_t| - |d_T - d_t| and S, the same of squares (Eq. 4.9, 4.10); (H, W), NaN where the target is 0.

    Positive where `ours` (T) is better than the baseline (M).
    """
    error_m, error_t = np.abs(baseline - target), np.abs(ours - target)
    invalid = target <= 0
    absolute, squared = error_m - error_t, error_m**2 - error_t**2
    absolute[invalid] = squared[invalid] = np.nan
    return absolute, squared


def relative_error_histograms(
    maps: Sequence[FloatMap], bins: int = 40, smallest: float = 1e-3
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Counts of improvements (> 0) and of |losses| (< 0) over shared, log-spaced bins (Fig. 4.8).

    Returns (bin edges (bins + 1,) in the maps' unit, improved (bins,), worsened (bins,)); values below `smallest` are
    left out on both sides. ValueError when no value is that large.
    """
    values = np.concatenate([m[np.isfinite(m)] for m in maps]) if len(maps) else np.zeros(0)
    largest = float(np.abs(values).max()) if values.size else 0.0
    if largest <= smallest:
        raise ValueError(f"no difference above {smallest} in {len(maps)} maps")
    edges = np.geomspace(smallest, largest * (1 + 1e-9), bins + 1)
    improved = np.histogram(values[values > 0], edges)[0].astype(np.int64)
    worsened = np.histogram(-values[values < 0], edges)[0].astype(np.int64)
    return edges, improved, worsened


def edge_region(foreground: Mask, width: float = 3.0) -> Mask:
    """Pixels whose Euclidean distance to the other side of the foreground boundary is below `width` (Table 4.2).

    foreground  (H, W) bool; distances are between pixel centres, so the two pixels beside the boundary have 1.
    All False when there is no boundary.
    """
    from scipy.ndimage import distance_transform_edt

    if foreground.all() or not foreground.any():
        return np.zeros_like(foreground)
    distance = np.where(foreground, distance_transform_edt(foreground), distance_transform_edt(~foreground))
    return np.asarray(distance < width)


def region_metrics(
    prediction: FloatMap, target: FloatMap, foreground: Mask, rules: str = "kitti", width: float = 3.0
) -> dict[str, dict[str, float]]:
    """`depth_metrics` over the whole image, the edge region and the rest: {"whole", "edge", "inside"}.

    A region without valid pixels is left out.
    """
    edge = edge_region(foreground, width)
    regions = {"whole": np.ones_like(edge), "edge": edge, "inside": ~edge}
    return {
        name: depth_metrics(prediction, np.where(region, target, 0), rules)
        for name, region in regions.items()
        if (target[region] > 0.1).any()
    }


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
    rows, columns = np.nonzero(_spans(target, window, step) & (prediction > 0))
    padded = np.pad(target, half)
    values = np.stack([padded[rows + i, columns + j] for i in range(window) for j in range(window)], 1)
    values = np.where(values > 0, values, np.inf)
    order = np.sort(values, 1)
    order = np.where(np.isfinite(order), order, order[:, :1])  # missing ones leave no gap: sort them to the front
    order.sort(1)
    gaps = np.diff(order, axis=1)
    widest = gaps.argmax(1)
    lines = np.arange(len(rows))
    near, far = order[lines, widest], order[lines, widest + 1]
    edge = far - near > np.maximum(step, 0.1 * near)
    if not edge.any():
        return float("nan")
    found = prediction[rows, columns]
    distance = np.abs(values - found[:, None]).min(1)
    mixed = (found > near + margin) & (found < far - margin) & (distance > margin)
    return float(mixed[edge].mean())


def _spans(target: FloatMap, window: int, step: float) -> Mask:
    """Pixels whose window spans more than `step` metres: a fast superset of the edges."""
    import cv2

    kernel = np.ones((window, window), np.uint8)
    largest = cv2.dilate(target, kernel)
    smallest = cv2.erode(np.where(target > 0, target, np.float32(1e6)), kernel)
    return np.asarray(largest - smallest > step)
