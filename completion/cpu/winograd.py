"""3x3 convolutions on the CPU with a quarter of the products: Winograd's F(4x4, 3x3), and what lies between them.

Lavin and Gray, "Fast Algorithms for Convolutional Neural Networks", CVPR 2016. A tile of 4x4 outputs needs 6x6 inputs;
each of 36 transformed places is an ordinary product with a matrix of weights: 2.25 products per output and pair of
channels instead of 9. A direct convolution cannot beat the matrix product of a machine, this one can.

The polynomials are evaluated at 0, +-a, +-b and infinity. The usual a = 1, b = 2 amplify rounding; with sqrt(1/2) and
sqrt(2), whose product is one, errors stay about twice those of a direct float32 convolution.

Maps are (H, W, C) float32 with the channels of a pixel together. Kernels work on a range of rows, release the
interpreter and write every pixel of it, so that rows can be shared among threads and maps be reused.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from completion.cpu.patches import COARSER, NOTHING, gather
from completion.cpu.small_gemm import ROWS, multiply, with_whole_lanes

Float = NDArray[np.float32]
_A, _B = math.sqrt(0.5), math.sqrt(2)
_POINTS = (0.0, _A, -_A, _B, -_B)
_a, _b, _a2, _b2, _a3, _b3 = (np.float32(value) for value in (_A, _B, _A**2, _B**2, _A**3, _B**3))
_SUM = np.float32(2.5)  # a^2 + b^2; a^2 b^2 is 1
_ZERO, _ONE = np.float32(0), np.float32(1)


def winograd_weights(weight: Tensor) -> Float:
    """Weights (O, I, 3, 3) -> (36, I, O') for `convolve`, computed in float64.

    O' is O with whole lanes (see `small_gemm`), here and in all weights below.
    """
    rows = []
    for point in _POINTS:
        scale = math.prod(point - other for other in _POINTS if other != point)
        rows.append([power / scale for power in (1.0, point, point * point)])
    rows.append([0.0, 0.0, 1.0])
    transform = np.array(rows)
    both = np.einsum("ia,jb,ocab->ijco", transform, transform, weight.detach().double().numpy())
    return with_whole_lanes(both.reshape(36, *both.shape[2:]).astype(np.float32))


@njit(inline="always")
def _evaluated(x0, x1, x2, x3, x4, x5):  # type: ignore[no-untyped-def]
    """One direction of the transform of inputs: six samples -> six points."""
    e, o = x4 - _b2 * x2, _a * (x3 - _b2 * x1)
    g, h = x4 - _a2 * x2, _b * (x3 - _a2 * x1)
    return x0 - _SUM * x2 + x4, e + o, e - o, g + h, g - h, x1 - _SUM * x3 + x5


@njit(inline="always")
def _interpolated(m0, m1, m2, m3, m4, m5):  # type: ignore[no-untyped-def]
    """One direction of the transform of outputs: six points -> four samples."""
    s, d, t, u = m1 + m2, m1 - m2, m3 + m4, m3 - m4
    return m0 + s + t, _a * d + _b * u, _a2 * s + _b2 * t, _a3 * d + _b3 * u + m5


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _stem(planes, weights, bias, top, left, work, patch):  # type: ignore[no-untyped-def]
    """patch (6, columns, C) from (top, left): rectified convolution of planes (K, H, W) by weights (9 K, C'), zeros
    outside."""
    strip, taps, m = work
    kinds, height, width = planes.shape
    rows, columns, channels = patch.shape
    for k in range(kinds):
        for i in range(rows + 2):
            r = top + i - 1
            for j in range(columns + 2):
                q = left + j - 1
                strip[k, i, j] = planes[k, r, q] if 0 <= r < height and 0 <= q < width else _ZERO
    for i in range(rows):
        if top + i < 0 or top + i >= height:
            patch[i] = _ZERO
            continue
        for j in range(columns):
            for k in range(kinds):
                for dy in range(3):
                    for dx in range(3):
                        taps[j, 9 * k + 3 * dy + dx] = strip[k, i + dy, j + dx]
        multiply(taps, weights, m)
        for j in range(columns):
            inside = 0 <= left + j < width
            for c in range(channels):
                value = m[j, c] + bias[c]
                patch[i, j, c] = value if inside and value > _ZERO else _ZERO


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _transform(patch, count, v):  # type: ignore[no-untyped-def]
    """patch (6, 4 count + 2, C), overwritten -> v (36, count, C)."""
    channels = patch.shape[2]
    flat = patch.reshape(6, -1)  # columns first, in one long loop: tiles share them
    for i in range((4 * count + 2) * channels):
        r = _evaluated(flat[0, i], flat[1, i], flat[2, i], flat[3, i], flat[4, i], flat[5, i])
        flat[0, i], flat[1, i], flat[2, i], flat[3, i], flat[4, i], flat[5, i] = r
    for i in range(6):
        p = 6 * i
        for t in range(count):
            x = patch[i, 4 * t : 4 * t + 6]
            for c in range(channels):
                r = _evaluated(x[0, c], x[1, c], x[2, c], x[3, c], x[4, c], x[5, c])
                v[p, t, c], v[p + 1, t, c], v[p + 2, t, c] = r[0], r[1], r[2]
                v[p + 3, t, c], v[p + 4, t, c], v[p + 5, t, c] = r[3], r[4], r[5]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _transform_columns_back(m, count):  # type: ignore[no-untyped-def]
    """m (36, count, O'): the first half of the transform of outputs, in place; its first 24 maps are left."""
    flat = m.reshape(36, -1)
    for j in range(6):
        for i in range(count * m.shape[2]):
            r = _interpolated(
                flat[j, i], flat[6 + j, i], flat[12 + j, i], flat[18 + j, i], flat[24 + j, i], flat[30 + j, i]
            )
            flat[j, i], flat[6 + j, i], flat[12 + j, i], flat[18 + j, i] = r


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _transform_row_back(m, t, bias, pixels):  # type: ignore[no-untyped-def]
    """The other half: m (6, count, O') at tile t, plus bias (O,) -> pixels (4, O)."""
    for c in range(len(bias)):
        r = _interpolated(m[0, t, c], m[1, t, c], m[2, t, c], m[3, t, c], m[4, t, c], m[5, t, c])
        pixels[0, c], pixels[1, c], pixels[2, c], pixels[3, c] = (
            r[0] + bias[c],
            r[1] + bias[c],
            r[2] + bias[c],
            r[3] + bias[c],
        )


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _add_upsampled(coarse, row, column, size, out):  # type: ignore[no-untyped-def]
    """out (C,) += coarse (h, w, C) at (row, column) of an image of `size`; bilinear with aligned corners."""
    height, width, channels = coarse.shape
    y = np.float32(row) * (np.float32(height - 1) / np.float32(max(size[0] - 1, 1)))
    x = np.float32(column) * (np.float32(width - 1) / np.float32(max(size[1] - 1, 1)))
    y0, x0 = int(y), int(x)
    y1, x1 = min(y0 + 1, height - 1), min(x0 + 1, width - 1)
    fy, fx = y - np.float32(y0), x - np.float32(x0)
    w00, w01, w10, w11 = (_ONE - fy) * (_ONE - fx), (_ONE - fy) * fx, fy * (_ONE - fx), fy * fx
    for c in range(channels):
        out[c] += w00 * coarse[y0, x0, c] + w01 * coarse[y0, x1, c] + w10 * coarse[y1, x0, c] + w11 * coarse[y1, x1, c]


@njit(cache=True, nogil=True, error_model="numpy")
def _finish(patch, weights, bias, row, start, count, other, kind, work, out):  # type: ignore[no-untyped-def]
    """The block of `count` tiles from column `start` of a row of tiles, once its patch is gathered."""
    v, m, border = work
    height, width, channels = out.shape
    _transform(patch, count, v)
    for p in range(36):
        multiply(v[p, :count], weights[p], m[p, :count])
    _transform_columns_back(m, count)
    for i in range(min(4, height - 4 * row)):
        y = 4 * row + i
        for t in range(count):
            x = 4 * (start + t)
            inside = min(4, width - x)
            pixels = out[y, x : x + 4] if inside == 4 else border
            _transform_row_back(m[6 * i : 6 * i + 6], t, bias, pixels)
            for j in range(inside if kind != NOTHING else 0):
                if kind == COARSER:
                    _add_upsampled(other, y, x + j, (height, width), pixels[j])
                else:
                    for c in range(channels):
                        pixels[j, c] += other[y, x + j, c]
            if inside < 4:
                out[y, x:width] = border[:inside]


@njit(inline="always")
def _blocks(weights, out):  # type: ignore[no-untyped-def]
    """Tiles of a block (18 for 64 channels), tiles across `out`, a block's patch, and memory for `_finish`."""
    inputs, outputs = weights.shape[1:]
    tiles = ROWS * max(1, 192 // max(inputs, outputs))
    patch = np.empty((6, 4 * tiles + 2, inputs), np.float32)
    work = (
        np.empty((36, tiles, inputs), np.float32),
        np.empty((36, tiles, outputs), np.float32),
        np.empty((4, out.shape[2]), np.float32),
    )
    return tiles, (out.shape[1] + 3) // 4, patch, work


@njit(cache=True, nogil=True, error_model="numpy")
def convolve(first, last, summands, layer, added, out):  # type: ignore[no-untyped-def]
    """Rows of tiles first..last of out (H, W, O): `Summands`, convolved by a `Layer`, plus its bias, plus `Added`.

    layer  weights (36, I, O'), see `winograd_weights`
    """
    x, y, z, terms, least = summands
    weights, bias = layer
    other, kind = added
    tiles, across, patch, work = _blocks(weights, out)
    for row in range(first, last):
        for start in range(0, across, tiles):
            count = min(tiles, across - start)
            gather(x, y, z, terms, least, 4 * row - 1, 4 * start - 1, 6, 4 * count + 2, 1, patch)
            _finish(patch, weights, bias, row, start, count, other, kind, work, out)


@njit(cache=True, nogil=True, error_model="numpy")
def convolve_stem(first, last, planes, stem_layer, layer, added, out):  # type: ignore[no-untyped-def]
    """`convolve` of the rectified convolution of planes (K, H, W) by a first layer (9 K, I'), see `stem_weights`."""
    stem, stem_bias = stem_layer
    weights, bias = layer
    other, kind = added
    tiles, across, patch, work = _blocks(weights, out)
    kinds, columns = len(planes), patch.shape[1]
    stem_work = (
        np.empty((kinds, 8, columns + 2), np.float32),
        np.empty((columns, len(stem)), np.float32),
        np.empty((columns, stem.shape[1]), np.float32),
    )
    for row in range(first, last):
        for start in range(0, across, tiles):
            count = min(tiles, across - start)
            _stem(planes, stem, stem_bias, 4 * row - 1, 4 * start - 1, stem_work, patch)
            _finish(patch, weights, bias, row, start, count, other, kind, work, out)


def tile_rows(out: Float) -> int:
    """Rows of tiles of a map: `last` of `convolve` and `convolve_stem` for all of it."""
    return (len(out) + 3) // 4


def stem_weights(weight: Tensor) -> Float:
    """Weights (O, K, 3, 3) of few inputs -> (9 K, O') for `convolve_stem`."""
    return with_whole_lanes(weight.detach().permute(1, 2, 3, 0).flatten(0, 2).numpy())
