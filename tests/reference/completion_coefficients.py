"""Depth Coefficients with plain loops (thesis Eq. 2.2, 3.3, 3.4)."""

from __future__ import annotations

import math

import numpy as np


def encode_one(depth: float, channels: int = 82, size: float = 1.0) -> np.ndarray:
    """Coefficients of one depth in guard layout."""
    code = np.zeros(channels)
    scaled = min(depth, (channels - 2) * size) / size
    nearest = round(scaled)
    if depth > 0 and nearest >= 1:
        delta = scaled - nearest
        code[nearest - 1 : nearest + 2] = (0.5 - delta) / 2, 0.5, (0.5 + delta) / 2
    return code


def decode_peak(code: np.ndarray, size: float = 1.0) -> float:
    """Weighted mean of the largest coefficient and its two neighbours."""
    k = min(max(int(code.argmax()), 1), len(code) - 2)
    three = code[k - 1 : k + 2]
    return float((three * np.arange(k - 1, k + 2) * size).sum() / three.sum())


def cross_entropy_dense(logits: np.ndarray, target: np.ndarray) -> float:
    """Mean over valid pixels of -sum c log p; logits (channels, H, W), target (H, W)."""
    total, count = 0.0, 0
    for i, j in np.argwhere(target > 0):
        code = encode_one(float(target[i, j]), logits.shape[0])
        if code.sum() == 0:
            continue
        column = logits[:, i, j]
        log_partition = math.log(np.exp(column - column.max()).sum()) + column.max()
        total += float((code * (log_partition - column)).sum())
        count += 1
    return total / count
