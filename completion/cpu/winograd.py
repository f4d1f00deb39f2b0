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
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from completion.cpu.small_gemm import ROWS, multiply, with_whole_lanes

Float = NDArray[np.float32]
_A, _B = math.sqrt(0.5), math.sqrt(2)
_POINTS = (0.0, _A, -_A, _B, -_B)
_a, _b, _a2, _b2, _a3, _b3 = (np.float32(value) for value in (_A, _B, _A**2, _B**2, _A**3, _B**3))
_SUM = np.float32(2.5)  # a^2 + b^2; a^2 b^2 is 1
_ZERO, _ONE = np.float32(0), np.float32(1)
# Lower bounds of the inputs of a convolution.
RECTIFIED, LINEAR = np.float32(0), np.float32(-np.inf)
# What a convolution adds to its result: nothing, a map of its size, a coarser one (bilinear with aligned corners).
NOTHING, SAME, COARSER = 0, 1, 2
# Pixels of a block of `halve`, `double` and `convolve_head`: few enough for a block to stay in the second-level cache.
PIXELS = 8 * ROWS


def winograd_weights(weight: Tensor) -> Float:
    """Weights (O, I, 3, 3) -> (36, I, O') for `convolve`, computed in float64.

    O' is O with whole lanes (see `small_product`), here and in all weights below.
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
def _gather(x, y, z, summands, least, top, left, rows, columns, step, patch):  # type: ignore[no-untyped-def]
    """patch (rows, columns, C): the sum of one to three maps from (top, left), cut at `least`, zeros outside.

    With step 2 the even columns come first, then the odd ones.
    """
    height, width, channels = x.shape
    for i in range(rows):
        r = top + i
        for j in range(columns):
            place = j if step == 1 else (j % 2) * ((columns + 1) // 2) + j // 2
            q = left + j
            if r < 0 or r >= height or q < 0 or q >= width:
                for c in range(channels):
                    patch[i, place, c] = _ZERO
            elif summands == 1:
                for c in range(channels):
                    value = x[r, q, c]
                    patch[i, place, c] = value if value > least else least
            elif summands == 2:
                for c in range(channels):
                    value = x[r, q, c] + y[r, q, c]
                    patch[i, place, c] = value if value > least else least
            else:
                for c in range(channels):
                    value = x[r, q, c] + y[r, q, c] + z[r, q, c]
                    patch[i, place, c] = value if value > least else least


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
def convolve(first, last, x, y, z, summands, least, weights, bias, other, kind, out):  # type: ignore[no-untyped-def]
    """Rows of tiles first..last of out (H, W, O): x + y + z, cut at `least`, convolved, plus bias, plus another map.

    x, y, z    (H, W, I), of which the first `summands` count
    weights    (36, I, O'), see `winograd_weights`
    least      RECTIFIED or LINEAR
    other      (H, W, O) or (h, w, O), as `kind` says: NOTHING, SAME or COARSER
    """
    tiles, across, patch, work = _blocks(weights, out)
    for row in range(first, last):
        for start in range(0, across, tiles):
            count = min(tiles, across - start)
            _gather(x, y, z, summands, least, 4 * row - 1, 4 * start - 1, 6, 4 * count + 2, 1, patch)
            _finish(patch, weights, bias, row, start, count, other, kind, work, out)


@njit(cache=True, nogil=True, error_model="numpy")
def convolve_stem(first, last, planes, stem, stem_bias, weights, bias, other, kind, out):  # type: ignore[no-untyped-def]
    """`convolve` of the rectified convolution of planes (K, H, W) by stem (9 K, I') and its bias (`stem_weights`)."""
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


def bias_of(layer: Any) -> Float:
    """The bias (O,) of a convolution."""
    return np.asarray(layer.bias.detach().contiguous().numpy())


def tap_weights(weight: Tensor, transposed: bool = False) -> Float:
    """Weights (O, I, 3, 3), or (I, O, 3, 3) when transposed -> (9, I, O') for `halve` and `double`."""
    order = (2, 3, 0, 1) if transposed else (2, 3, 1, 0)
    return with_whole_lanes(weight.detach().permute(order).flatten(0, 1).numpy())


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def halve(first, last, x, weights, bias, out):  # type: ignore[no-untyped-def]
    """Rows first..last of out (H/2, W/2, O): relu(x), (H, W, I), convolved with stride 2 and padding 1, plus bias."""
    inputs, columns = weights.shape[1:]
    patch = np.empty((3, 2 * PIXELS + 1, inputs), np.float32)
    m = np.empty((9, PIXELS, columns), np.float32)
    width = out.shape[1]
    for row in range(first, last):
        for start in range(0, width, PIXELS):
            n = min(PIXELS, width - start)
            _gather(x, x, x, 1, RECTIFIED, 2 * row - 1, 2 * start - 1, 3, 2 * n + 1, 2, patch)
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
def double(first, last, x, y, z, summands, weights, bias, out):  # type: ignore[no-untyped-def]
    """Rows first..last of x (H, W, I) -> two rows each of out (2H, 2W, O): relu(x + y + z) by a transposed convolution
    of stride 2 (padding and output padding 1), plus bias."""
    inputs, columns = weights.shape[1:]
    patch = np.empty((2, PIXELS + 1, inputs), np.float32)
    m = np.empty((9, PIXELS, columns), np.float32)
    width = x.shape[1]
    for row in range(first, last):
        for start in range(0, width, PIXELS):
            n = min(PIXELS, width - start)
            _gather(x, y, z, summands, RECTIFIED, row, start, 2, n + 1, 1, patch)
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


def stem_weights(weight: Tensor) -> Float:
    """Weights (O, K, 3, 3) of few inputs -> (9 K, O') for `convolve_stem`."""
    return with_whole_lanes(weight.detach().permute(1, 2, 3, 0).flatten(0, 2).numpy())


def quarter_weights(weight: Tensor) -> Float:
    """Weights (O, I, 2, 2) -> (2, 2 I, O') for `quarter`."""
    return with_whole_lanes(weight.detach().permute(2, 3, 1, 0).flatten(1, 2).numpy())


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def quarter(first, last, pairs, weights, bias, out):  # type: ignore[no-untyped-def]
    """Rows first..last of out (H/2, W/2, O): x convolved by 2x2 with stride 2, plus bias.

    pairs  (H/2, 2, W/2, 2 I), a view of x (H, W, I): the two pixels of a row that belong together lie together
    """
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
def lift(first, last, x, weights, bias, skip, out):  # type: ignore[no-untyped-def]
    """Rows first..last of x (h, w, I) -> two rows each of out (2h, 2w, O): weights (I, O'), bias, each pixel repeated
    2x2, plus skip."""
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
def convolve_head(first, last, x, weights, bias, out):  # type: ignore[no-untyped-def]
    """Rows first..last of planes out (O, H, W): relu(x), (H, W, I), convolved to few channels, plus bias.

    All nine taps of a row are one product; the rows above and below are kept.
    """
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
                _gather(x, x, x, 1, RECTIFIED, row, start, 1, n, 1, patch)
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
