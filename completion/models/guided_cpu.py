"""The guided network's arithmetic outside its convolutions, fused for the CPU: same values as the torch version.

Two passes over the image with numba instead of some sixty tensor operations; used for inference on the CPU.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from completion.models.candidates import COLUMN_SHIFTS, SECOND_RING_ROWS

Float = NDArray[np.float32]
_BLOCK = 64  # columns one thread walks down together
_FAR = np.float32(-30.0)


@njit(parallel=True, cache=True, nogil=True)
def rings(sparse: Float) -> tuple[Float, Float]:
    """Sparse (H, W) -> depth and distance in rows, both (4, H, W): ring above, below, second above, second below.

    Depth is 0 where there is no such ring. See `candidates.find_candidates`.
    """
    height, width = sparse.shape
    depth = np.zeros((4, height, width), np.float32)
    rows = np.zeros((4, height, width), np.float32)
    filled = np.empty((height, width), np.float32)
    index = np.empty((2, height, width), np.int32)
    for block in prange((width + _BLOCK - 1) // _BLOCK):
        first, last = block * _BLOCK, min(width, (block + 1) * _BLOCK)
        for y in range(height):
            for x in range(first, last):
                value = sparse[y, x]
                if value <= 0:
                    left = sparse[y, x - 1] if x > 0 else np.float32(0)
                    right = sparse[y, x + 1] if x + 1 < width else np.float32(0)
                    value = min(left, right) if left > 0 and right > 0 else max(left, right)
                filled[y, x] = value
                above = index[0, y - 1, x] if y > 0 else -1
                index[0, y, x] = y if value > 0 else above
        for y in range(height - 1, -1, -1):
            for x in range(first, last):
                below = index[1, y + 1, x] if y + 1 < height else height
                index[1, y, x] = y if filled[y, x] > 0 else below
        for y in range(height):
            for x in range(first, last):
                up, down = index[0, y, x], index[1, y, x]
                if up >= 0:
                    depth[0, y, x], rows[0, y, x] = filled[up, x], y - up
                    second = index[0, up - SECOND_RING_ROWS, x] if up >= SECOND_RING_ROWS else -1
                    if second >= 0:
                        depth[2, y, x], rows[2, y, x] = filled[second, x], y - second
                if down < height:
                    depth[1, y, x], rows[1, y, x] = filled[down, x], down - y
                    beyond = down + SECOND_RING_ROWS
                    second = index[1, beyond, x] if beyond < height else height
                    if second < height:
                        depth[3, y, x], rows[3, y, x] = filled[second, x], second - y
    return depth, rows


@njit(inline="always")
def _squareplus(x: float) -> float:
    return 0.5 * (x + math.sqrt(x * x + 4))


@njit(inline="always")
def _softsign(x: float) -> float:
    return x / (1 + abs(x))


@njit(parallel=True, cache=True, nogil=True)
def assemble(
    head: Float,
    log_depth: Float,
    prior: Float,
    shifts: NDArray[np.int64],
    residual: float,
    cut: float,
    tilt_bias: float,
) -> Float:
    """Head at half resolution and rings -> (3, H, W): foreground, background in metres, sigma logit.

    head              (H/2, W/2, 4 C), the pixel-shuffle layout: channel c of pixel (y, x) at 4 c + 2 (y % 2) + x % 2
    log_depth, prior  (4, H, W), of the four rings; the prior is -30 where there is none
    """
    height, width = log_depth.shape[1:]
    measured = 2 * len(shifts) + 2
    count = measured + 1
    floor = math.log(cut) if cut > 0 else -80.0
    out = np.empty((3, height, width), np.float32)
    for y in prange(height):
        z = np.empty(count, np.float32)
        p = np.empty(count, np.float32)
        near = np.empty(count, np.float32)
        far = np.empty(count, np.float32)
        for x in range(width):
            pixel = head[y // 2, x // 2]
            corner = 2 * (y % 2) + x % 2
            rest = 4 * 2 * count + corner
            for s in range(len(shifts)):
                column = x + shifts[s]
                for r in range(2):
                    k = 2 * s + r
                    if 0 <= column < width and prior[r, y, column] > -29:
                        z[k] = log_depth[r, y, column]
                        p[k] = prior[r, y, column] - 0.4 * abs(shifts[s])
                    else:
                        z[k], p[k] = math.log(10.0), _FAR
            for r in range(2):
                k = measured - 2 + r
                z[k] = log_depth[2 + r, y, x]
                p[k] = prior[2 + r, y, x] - 4.0 if prior[2 + r, y, x] > -29 else _FAR
            z[measured] = 0.3 + 2.3 * _softsign(pixel[rest + 16]) + math.log(10.0)
            p[measured] = -5.0
            tilt_near = _squareplus(pixel[rest] + tilt_bias)
            tilt_far = _squareplus(pixel[rest + 4] + tilt_bias)
            top_near, top_far = np.float32(-1e9), np.float32(-1e9)
            for k in range(count):
                near[k] = p[k] + pixel[4 * k + corner] - tilt_near * z[k]
                far[k] = p[k] + pixel[4 * (count + k) + corner] + tilt_far * z[k]
                top_near, top_far = max(top_near, near[k]), max(top_far, far[k])
            sum_near, mix_near, sum_far, mix_far = 0.0, 0.0, 0.0, 0.0
            for k in range(count):
                if near[k] - top_near > floor:
                    weight = math.exp(near[k] - top_near) - cut
                    sum_near += weight
                    mix_near += weight * math.exp(-z[k])
                if far[k] - top_far > floor:
                    weight = math.exp(far[k] - top_far) - cut
                    sum_far += weight
                    mix_far += weight * math.exp(-z[k])
            one = (1 + residual * _softsign(pixel[rest + 8])) * sum_near / mix_near
            two = (1 + residual * _softsign(pixel[rest + 12])) * sum_far / mix_far
            out[0, y, x], out[1, y, x] = min(one, two), max(one, two)
            out[2, y, x] = pixel[rest + 20]
    return out


def log_and_prior(depth: Float, rows: Float) -> tuple[Float, Float]:
    """Depth and rows of the four rings -> log depth (log 10 m where missing) and prior without the shift's penalty."""
    exists = depth > 0
    log_depth = np.log(np.where(exists, depth, np.float32(10.0)))
    return log_depth, np.where(exists, -np.log(rows + np.float32(0.5)), _FAR)


def shifts_array() -> NDArray[np.int64]:
    """Column shifts of the candidates in their order."""
    return np.array(COLUMN_SHIFTS, np.int64)
