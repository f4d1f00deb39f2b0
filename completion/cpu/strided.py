"""The convolutions of a CPU that Winograd's transform does not fit: strides, transposed, and to few channels.

Sums of the products of whole runs of pixels (`small_gemm`); maps and rows as in `winograd`.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from completion.cpu.patches import PIXELS, RECTIFIED, gather
from completion.cpu.small_gemm import multiply, with_whole_lanes

Float = NDArray[np.float32]
_ZERO = np.float32(0)


def tap_weights(weight: Tensor, transposed: bool = False) -> Float:
    """Weights (O, I, 3, 3), or (I, O, 3, 3) when transposed -> (9, I, O') for `halve` and `double`."""
    order = (2, 3, 0, 1) if transposed else (2, 3, 1, 0)
    return with_whole_lanes(weight.detach().permute(order).flatten(0, 1).numpy())


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def halve(first, last, x, layer, out):  # type: ignore[no-untyped-def]
    """Rows first..last of out (H/2, W/2, O): relu(x), (H, W, I), convolved with stride 2 and padding 1, plus bias."""
    weights, bias = layer
    inputs, columns = weights.shape[1:]
    patch = np.empty((3, 2 * PIXELS + 1, inputs), np.float32)
    m = np.empty((9, PIXELS, columns), np.float32)
    width = out.shape[1]
    for row in range(first, last):
        for start in range(0, width, PIXELS):
            n = min(PIXELS, width - start)
            gather(x, x, x, 1, RECTIFIED, 2 * row - 1, 2 * start - 1, 3, 2 * n + 1, 2, patch)
            for i in range(3):
                multiply(patch[i, :n], weights[3 * i], m[3 * i, :n])
                multiply(patch[i, n + 1 : 2 * n + 1], weights[3 * i + 1], m[3 * i + 1, :n])
                multiply(patch[i, 1 : n + 1], weights[3 * i + 2], m[3 * i + 2, :n])
            for j in range(n):
                for c in range(len(bias)):
                    upper = m[0, j, c] + m[1, j, c] + m[2, j, c]
                    middle = m[3, j, c] + m[4, j, c] + m[5, j, c]
                    lower = m[6, j, c] + m[7, j, c] + m[8, j, c]
                    out[row, start + j, c] = bias[c] + (upper + middle + lower)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def double(first, last, summands, layer, out):  # type: ignore[no-untyped-def]
    """Rows first..last of `Summands` (H, W, I) -> two rows each of out (2H, 2W, O): transposed convolution of stride 2
    (padding and output padding 1), plus bias."""
    x, y, z, count, least = summands
    weights, bias = layer
    inputs, columns = weights.shape[1:]
    patch = np.empty((2, PIXELS + 1, inputs), np.float32)
    m = np.empty((9, PIXELS, columns), np.float32)
    width = x.shape[1]
    for row in range(first, last):
        for start in range(0, width, PIXELS):
            n = min(PIXELS, width - start)
            gather(x, y, z, count, least, row, start, 2, n + 1, 1, patch)
            for i in range(3):
                source = patch[1 if i == 0 else 0]
                for k in range(3):
                    shift = 1 if k == 0 else 0
                    multiply(source[shift : shift + n], weights[3 * i + k], m[3 * i + k, :n])
            for j in range(n):
                left = 2 * (start + j)
                for c in range(len(bias)):
                    out[2 * row, left, c] = bias[c] + m[4, j, c]
                    out[2 * row, left + 1, c] = bias[c] + (m[3, j, c] + m[5, j, c])
                    out[2 * row + 1, left, c] = bias[c] + (m[1, j, c] + m[7, j, c])
                    corners = (m[0, j, c] + m[2, j, c]) + (m[6, j, c] + m[8, j, c])
                    out[2 * row + 1, left + 1, c] = bias[c] + corners


def quarter_weights(weight: Tensor) -> Float:
    """Weights (O, I, 2, 2) -> (2, 2 I, O') for `quarter`."""
    return with_whole_lanes(weight.detach().permute(2, 3, 1, 0).flatten(1, 2).numpy())


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def quarter(first, last, pairs, layer, out):  # type: ignore[no-untyped-def]
    """Rows first..last of out (H/2, W/2, O): x convolved by 2x2 with stride 2, plus bias.

    pairs  (H/2, 2, W/2, 2 I), a view of x (H, W, I): the two pixels of a row that belong together lie together
    """
    weights, bias = layer
    m = np.empty((2, PIXELS, weights.shape[2]), np.float32)
    for row in range(first, last):
        for start in range(0, out.shape[1], PIXELS):
            n = min(PIXELS, out.shape[1] - start)
            for i in range(2):
                multiply(pairs[row, i, start : start + n], weights[i], m[i, :n])
            for j in range(n):
                for c in range(len(bias)):
                    out[row, start + j, c] = bias[c] + (m[0, j, c] + m[1, j, c])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def lift(first, last, x, layer, skip, out):  # type: ignore[no-untyped-def]
    """Rows first..last of x (h, w, I) -> two rows each of out (2h, 2w, O): weights (I, O'), bias, each pixel repeated
    2x2, plus skip."""
    weights, bias = layer
    m = np.empty((PIXELS, weights.shape[1]), np.float32)
    for row in range(first, last):
        for start in range(0, x.shape[1], PIXELS):
            n = min(PIXELS, x.shape[1] - start)
            multiply(x[row, start : start + n], weights, m[:n])
            for y in range(2 * row, 2 * row + 2):
                for j in range(2 * n):
                    column = 2 * start + j
                    for c in range(len(bias)):
                        out[y, column, c] = skip[y, column, c] + (m[j // 2, c] + bias[c])


def head_weights(weight: Tensor) -> Float:
    """Weights (O, I, 3, 3) of few outputs -> (I, 9 O, with whole lanes) for `convolve_head`."""
    return with_whole_lanes(weight.detach().permute(1, 2, 3, 0).flatten(1).numpy())


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def convolve_head(first, last, x, layer, out):  # type: ignore[no-untyped-def]
    """Rows first..last of planes out (O, H, W): relu(x), (H, W, I), convolved to few channels, plus bias.

    All nine taps of a row are one product; the rows above and below are kept.
    """
    weights, bias = layer
    height, width, inputs = x.shape
    kinds = out.shape[0]
    patch = np.empty((1, PIXELS, inputs), np.float32)
    m = np.empty((PIXELS, weights.shape[1]), np.float32)
    rows = np.zeros((3, width + 2, weights.shape[1]), np.float32)
    for row in range(first - 1, last + 1):
        kept = rows[(row + 3) % 3]
        if row < 0 or row >= height:
            kept[:] = _ZERO
        else:
            for start in range(0, width, PIXELS):
                n = min(PIXELS, width - start)
                gather(x, x, x, 1, RECTIFIED, row, start, 1, n, 1, patch)
                multiply(patch[0, :n], weights, m[:n])
                kept[1 + start : 1 + start + n] = m[:n]
        if row <= first:
            continue
        for k in range(kinds):
            for column in range(width):
                total = bias[k]
                for i in range(3):
                    taps = rows[(row - 2 + i + 3) % 3]
                    for j in range(3):
                        total += taps[column + j, (3 * i + j) * kinds + k]
                out[k, row - 1, column] = total
