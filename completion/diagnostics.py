"""Is a network alive? Its error with the true picture, a flat and another one, and whether sigma separates surfaces."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from auglidar_base.errors import SettingsError
from completion.analysis import mixed_share
from completion.infer import Completer
from completion.pictures import other_picture, pictures_of
from completion.types import CompletedDepth, DepthFrame, FloatMap


def edge_mask(target: FloatMap, window: int = 5) -> NDArray[np.bool_]:
    """Pixels (H, W) whose valid target depths within `window` span more than 1 m and 10 %."""
    kernel = np.ones((window, window), np.uint8)
    largest = cv2.dilate(target, kernel)
    smallest = cv2.erode(np.where(target > 0, target, np.float32(1e6)), kernel)
    return (target > 0) & (largest - smallest > 1) & (largest > 1.1 * smallest)


def measured_region(frame: DepthFrame, max_depth: float = 80.0) -> FloatMap:
    """Target (H, W) with 0 where a LiDAR says nothing: beyond `max_depth` metres, and above its topmost sample nearby.

    A frame without samples keeps all its target up to `max_depth`. ValueError without a target.
    """
    if frame.target is None:
        raise ValueError("expected a frame with a target")
    target = np.where(frame.target <= max_depth, frame.target, np.float32(0))
    if not (frame.sparse > 0).any():
        return target
    near = cv2.dilate((frame.sparse > 0).astype(np.uint8), np.ones((1, 33), np.uint8))
    return target * np.maximum.accumulate(near, axis=0)


def sigma_statistics(completed: CompletedDepth, target: FloatMap, threshold: float = 1.0) -> dict[str, float]:
    """Sigma at pixels of depth edges whose surfaces differ by more than `threshold` metres.

    sigma_spread       standard deviation of sigma there: about 0 when the surfaces are never chosen between
    sigma_correlation  with 'the foreground is nearer to the truth' (1 = perfect, 0 = none or undefined)
    sigma_correct      share of pixels where sigma > 0.5 chooses the nearer surface
    surfaces_apart     share of edge pixels with surfaces that differ that much
    """
    if completed.foreground is None or completed.background is None or completed.sigma is None:
        return {}
    edges = edge_mask(target)
    apart = edges & (completed.background - completed.foreground > threshold)
    share = float(apart.sum() / max(1, int(edges.sum())))
    sigma = completed.sigma[apart].astype(np.float64)
    near = np.abs(completed.foreground - target)[apart] < np.abs(completed.background - target)[apart]
    if len(sigma) < 2:
        return {"sigma_spread": 0.0, "sigma_correlation": 0.0, "sigma_correct": 0.0, "surfaces_apart": share}
    spread = float(sigma.std())
    correlation = float(np.corrcoef(sigma, near)[0, 1]) if spread > 0 and 0 < near.sum() < len(near) else 0.0
    return {
        "sigma_spread": spread,
        "sigma_correlation": correlation,
        "sigma_correct": float(((sigma > 0.5) == near).mean()),
        "surfaces_apart": share,
    }


def _scores(completed: CompletedDepth, target: FloatMap) -> dict[str, float]:
    valid = target > 0
    error = np.abs(completed.depth - target)[valid] * 1000
    edges = edge_mask(target)[valid]
    return {
        "mae_mm": float(error.mean()),
        "tmae_mm": float(np.minimum(error, 1000).mean()),
        "edge_tmae_mm": float(np.minimum(error[edges], 1000).mean()) if edges.any() else float("nan"),
        "mixed_percent": 100 * mixed_share(completed.depth, target),
    }


def diagnose(completer: Completer, frames: Iterable[DepthFrame]) -> dict[str, float]:
    """Mean over frames with a target: MAE, tMAE (t = 1 m), edge tMAE in mm, mixed pixels in %; the same with a grey
    picture (`grey_...`) and with another frame's (`other_...`, see `completion.pictures`), equal when the picture is
    ignored; sigma's statistics. All within `measured_region`. Frames without an edge drop out of the means that need
    one. ValueError when no frame has a target.
    """
    all_frames = list(frames)
    images = [frame.image for frame in all_frames]
    rows: list[dict[str, float]] = []
    for number, frame in enumerate(all_frames):
        target = measured_region(frame) if frame.target is not None else np.zeros(frame.size, np.float32)
        if not target.any():
            continue
        row: dict[str, float] = {}
        for name, picture in pictures_of(frame.image, other_picture(number, images)).items():
            completed = completer.complete(frame.sparse, picture, frame.K)
            prefix = "" if name == "true" else f"{name}_"
            row |= {f"{prefix}{key}": value for key, value in _scores(completed, target).items()}
            if name == "true":
                row |= sigma_statistics(completed, target)
        rows.append(row)
    if not rows:
        raise SettingsError("no frame with a target to diagnose on")
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return {
        name: float(values[np.isfinite(values)].mean()) if np.isfinite(values).any() else float("nan")
        for name, values in columns.items()
    }
