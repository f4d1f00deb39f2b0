"""Non-local propagation spelled out pixel by pixel in float64."""

from __future__ import annotations

import math

import numpy as np


def bilinear(values: np.ndarray, row: float, column: float) -> float:
    """The sample of a map (H, W) at a fractional place; corners outside count 0."""
    top, left = math.floor(row), math.floor(column)
    total = 0.0
    for y in (top, top + 1):
        for x in (left, left + 1):
            if 0 <= y < values.shape[0] and 0 <= x < values.shape[1]:
                total += (1 - abs(row - y)) * (1 - abs(column - x)) * float(values[y, x])
    return total


def confidence_times(affinities: np.ndarray, confidence: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Affinities (n, H, W) times the confidence at p + offset (n, 2, H, W)."""
    out = np.zeros(affinities.shape)
    for j, y, x in np.ndindex(*affinities.shape):
        row, column = offsets[j, :, y, x]
        out[j, y, x] = affinities[j, y, x] * bilinear(confidence, y + row, x + column)
    return out


def propagate_once(depth: np.ndarray, offsets: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """One iteration: offsets (K^2, 2, H, W), weights (K^2, H, W), depth (H, W)."""
    kernel = math.isqrt(len(weights))
    out = np.zeros(depth.shape)
    for tap, y, x in np.ndindex(*weights.shape):
        cell_row, cell_column = tap // kernel - kernel // 2, tap % kernel - kernel // 2
        row, column = offsets[tap, :, y, x]
        out[y, x] += weights[tap, y, x] * bilinear(depth, y + cell_row + row, x + cell_column + column)
    return out


def propagate(
    depth: np.ndarray, offsets: np.ndarray, weights: np.ndarray, iterations: int, kept: np.ndarray | None = None
) -> np.ndarray:
    """All iterations; where `kept` is > 0 it replaces the map before each."""
    for _ in range(iterations):
        if kept is not None:
            depth = np.where(kept > 0, kept, depth)
        depth = propagate_once(depth, offsets, weights)
    return depth


def offsets_and_weights(
    raw: np.ndarray, confidence: np.ndarray | None, affinity: str, scale: float, legacy: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Raw channels (3 n, H, W) -> offsets (n + 1, 2, H, W) and weights (n + 1, H, W), the centre in the middle."""
    n = len(raw) // 3
    kernel, middle = math.isqrt(n + 1), n // 2
    offsets = np.zeros((n + 1, 2, *raw.shape[1:]))
    weights = np.zeros((n + 1, *raw.shape[1:]))
    for j in range(n):
        tap = j if j < middle else j + 1
        offsets[tap] = raw[2 * j], raw[2 * j + 1]
        a = raw[2 * n + j]
        weights[tap] = {"TC": np.tanh(a) / scale, "TGASS": np.tanh(a) / (scale + 1e-8)}.get(affinity, a)
        if confidence is not None:
            if legacy:
                offsets[tap, 0] += tap // kernel - kernel // 2
                offsets[tap, 1] += tap % kernel - kernel // 2
            weights[tap] = confidence_times(weights[tap, None], confidence, offsets[tap, None])[0]
    for y, x in np.ndindex(*raw.shape[1:]):
        total = np.abs(weights[:, y, x]).sum() + 1e-4
        if affinity != "TC" and not (affinity != "AS" and total < 1):
            weights[:, y, x] /= total
    weights[middle] = 1 - weights.sum(0)
    return offsets, weights
