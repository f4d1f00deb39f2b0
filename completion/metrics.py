"""Metrics of depth completion for one image, under the validity and clamping rules of six evaluation codes.

Per image over valid pixels; a data set's figure is the plain mean over images (`mean_metrics`). Thesis Eq. 2.4, 2.5 for
the thresholded errors.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

DELTAS = {  # thresholds of max(p / g, g / p): the usual three and the finer set of thesis Table 3.1
    "delta_1.02": 1.02,
    "delta_1.05": 1.05,
    "delta_1.10": 1.10,
    "delta_1.25": 1.25,
    "delta_1.25^2": 1.25**2,
    "delta_1.25^3": 1.25**3,
}


@dataclass(frozen=True)
class Rules:
    """What one evaluation code counts.

    smallest             target pixels are valid above this many metres (strictly, both as float32 like the codes')
    positive_prediction  MAE, RMSE and the like also need a prediction > 0 (msg_chn: drops the worst pixels)
    clamp_all            prediction clamped to [0, cap] and target to cap before everything (DC)
    clamp_deltas         the deltas see the prediction clamped to [0, cap] (TWISE: its clamp works in place)
    zero_inverse         inverse depths of predictions <= 0 count as 0 rather than being floored at 0.1 m
    """

    smallest: float = 0.0
    positive_prediction: bool = False
    clamp_all: bool = False
    clamp_deltas: bool = False
    zero_inverse: bool = False


RULES = {
    "kitti": Rules(),
    "twise": Rules(smallest=0.1, clamp_deltas=True),
    "ma": Rules(smallest=0.1),
    "msg_chn": Rules(positive_prediction=True, zero_inverse=True),
    "nlspn": Rules(smallest=1e-4, zero_inverse=True),
    "dc": Rules(clamp_all=True),
}
FLOOR = 0.1  # metres; smallest prediction that inverse and logarithmic metrics see


def depth_metrics(
    prediction: Any,
    target: Any,
    rules: str = "kitti",
    threshold: float = 1.0,
    cap: float = 80.0,
    strict_reference: bool = False,
) -> dict[str, float]:
    """Metrics of one depth map, metres in.

    prediction, target  (H, W) metres, 0 = no value in the target; arrays or CPU tensors of one shape
    rules      "kitti" (devkit: target > 0), "twise", "ma", "msg_chn", "nlspn", "dc"
    threshold  t of tMAE and tRMSE: 1 m outdoors, 0.1 m indoors
    cap        metres; tMAE and tRMSE clamp the prediction to [0, cap] and leave out deeper targets (10 m indoors)
    strict_reference  predictions of 0 give infinite inverse and NaN logarithmic metrics, as in the reference codes

    Keys: mae_mm, rmse_mm, tmae_mm, trmse_mm; imae_per_km, irmse_per_km; rel, squared_rel (mean of (error / target)^2);
    delta_1.02, _1.05, _1.10, _1.25, _1.25^2, _1.25^3 in percent; lg10; silog; valid_pixels;
    floored_pixels (predictions below 0.1 m raised to it for the inverse and logarithmic metrics).
    ValueError for shapes that differ, unknown rules, or no valid pixel.
    """
    if rules not in RULES:
        raise ValueError(f"rules: expected one of {', '.join(RULES)}, got {rules!r}")
    rule = RULES[rules]
    p, g = np.asarray(prediction, np.float64), np.asarray(target, np.float64)
    if p.shape != g.shape:
        raise ValueError(f"prediction {p.shape} and target {g.shape} must have one shape")
    # In float64 a float32 target of 0.1 m is greater than 0.1; the codes compare float32 with float32.
    valid = np.asarray(target, np.float32) > np.float32(rule.smallest)
    if not valid.any():
        raise ValueError(f"no valid target pixel (rules {rules!r}: target > {rule.smallest} m)")
    p, g = p[valid], g[valid]
    if rule.clamp_all:
        p, g = p.clip(0, cap), g.clip(max=cap)
    inverse_p, log_p, floored = _inverse_inputs(p, rule, strict_reference)
    inverse = _inverse(inverse_p, g, log_p)
    if rule.positive_prediction:
        p, g = p[p > 0], g[p > 0]
    result = _plain(p, g) | _thresholded(p, g, threshold, cap) | inverse
    result |= _deltas(p.clip(0, cap) if rule.clamp_deltas else p, g)
    return result | {"valid_pixels": float(valid.sum()), "floored_pixels": float(floored)}


def _mean(values: Values) -> float:
    return float(values.mean()) if values.size else float("nan")


def _plain(p: Values, g: Values) -> dict[str, float]:
    error = np.abs(p - g)
    return {
        "mae_mm": 1000 * _mean(error),
        "rmse_mm": 1000 * float(np.sqrt(_mean(error**2))),
        "rel": _mean(error / g),
        "squared_rel": _mean((error / g) ** 2),
    }


def _thresholded(p: Values, g: Values, threshold: float, cap: float) -> dict[str, float]:
    """Eq. 2.4 and 2.5 over targets up to `cap`."""
    within = g <= cap
    error = np.minimum(np.abs(p[within].clip(0, cap) - g[within]), threshold)
    return {"tmae_mm": 1000 * _mean(error), "trmse_mm": 1000 * float(np.sqrt(_mean(error**2)))}


def _inverse_inputs(p: Values, rule: Rules, strict_reference: bool) -> tuple[Values, Values, int]:
    """Inverse predictions in 1/m, predictions for logarithms, and how many were floored."""
    with np.errstate(divide="ignore"):
        if strict_reference and not rule.zero_inverse:
            return 1 / p, p, 0
        floored = p.clip(min=FLOOR)
        if rule.zero_inverse:
            return np.where(p > 0, 1 / p, 0.0), p if strict_reference else floored, int((p < FLOOR).sum())
    return 1 / floored, floored, int((p < FLOOR).sum())


def _inverse(inverse_p: Values, g: Values, log_p: Values) -> dict[str, float]:
    """iMAE and iRMSE in 1/km, lg10 and silog."""
    with np.errstate(divide="ignore", invalid="ignore"):
        error = 1000 * np.abs(inverse_p - 1 / g)
        ratio = np.log(g) - np.log(log_p)
        return {
            "imae_per_km": _mean(error),
            "irmse_per_km": float(np.sqrt(_mean(error**2))),
            "lg10": _mean(np.abs(ratio)) / float(np.log(10)),
            "silog": 100 * float(np.sqrt(ratio.var())),
        }


def _deltas(p: Values, g: Values) -> dict[str, float]:
    with np.errstate(divide="ignore"):
        ratio = np.maximum(p / g, g / p)
    return {name: 100 * _mean((ratio < bound).astype(np.float64)) for name, bound in DELTAS.items()}


def mean_metrics(images: Iterable[dict[str, float]]) -> dict[str, float]:
    """Plain mean of each metric over images; pixel counts are summed. ValueError when there is none."""
    rows = list(images)
    if not rows:
        raise ValueError("no image to average over")
    summed = ("valid_pixels", "floored_pixels")
    return {
        name: float(np.sum([r[name] for r in rows]) if name in summed else np.mean([r[name] for r in rows]))
        for name in rows[0]
    }
