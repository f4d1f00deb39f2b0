"""What surrounds the convolutions of `selection.Selection`, for inference on the CPU: the same values, much faster.

Two passes over the image with numba instead of some eighty tensor operations. Both work on runs of pixels of one row
that fit the first-level cache, in plain loops the compiler turns into vector instructions; that is why the exponential
is written out here. Rows are shared among as many threads as torch uses.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from completion.inputs import scale_rgb
from completion.mixture import surface_shares
from completion.models.pixel_unet_cpu import PixelUNetKernels
from completion.models.rings import interpolate_rows, sweep
from completion.models.selection import CANDIDATES, CHANNELS, COLUMN_SHIFTS, INPUTS, Selection
from completion.models.small_product import multiply
from completion.twin_surface import fuse

Float = NDArray[np.float32]
GAMMA = 2.0
_RUN = 128  # pixels
_MEASURED = CANDIDATES - 1
_ONE, _TWO, _HALF, _ZERO = np.float32(1), np.float32(2), np.float32(0.5), np.float32(0)
_LOG2_E, _ROUND = np.float32(1 / math.log(2)), np.float32(128.5)
_LN2_HIGH, _LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
_LEAST, _MOST = np.float32(-86), np.float32(86)
_TAYLOR = tuple(np.float32(1 / math.factorial(n)) for n in range(8))


@njit(inline="always")
def _exp(x):  # type: ignore[no-untyped-def]
    """Float32 exponential to 2e-7 relative, cut at exp(+-86): 2^n times a Taylor polynomial on +-ln(2) / 2."""
    x = _LEAST if x < _LEAST else x
    x = _MOST if x > _MOST else x
    n = np.int32(np.int32(x * _LOG2_E + _ROUND) - np.int32(128))
    whole = np.float32(n)
    r = x - whole * _LN2_HIGH - whole * _LN2_LOW
    p = _TAYLOR[6] + r * _TAYLOR[7]
    p = _TAYLOR[4] + r * (_TAYLOR[5] + r * p)
    p = _TAYLOR[2] + r * (_TAYLOR[3] + r * p)
    p = _ONE + r * (_ONE + r * p)
    return p * np.int32(np.int32(n + np.int32(127)) << np.int32(23)).view(np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _write_inputs(first, last, image, colours, sparse, rings, logs, out):  # type: ignore[no-untyped-def]
    """Network inputs of half-resolution rows first..last; see `selection.depth_features` and torch's pixel_unshuffle.

    image (H, W, 3) uint8, colours (3, 256) their scaled values, rings (5, H, W), logs (3, H, W) natural logarithms of
    the first three rings, out (H/2, W/2, 40)
    """
    height, width = sparse.shape
    run = np.empty((INPUTS, _RUN), np.float32)
    for y in range(2 * first, 2 * last):
        run[9] = np.float32(2 * y / (height - 1) - 1)
        for start in range(0, width, _RUN):
            count = min(_RUN, width - start)
            for i in range(count):
                x = start + i
                for c in range(3):
                    run[c, i] = colours[c, image[y, x, c]]
                run[3, i] = logs[2, y, x] - np.float32(2.7)
                run[8, i] = _ONE if sparse[y, x] > 0 else _ZERO
            for side in range(2):
                for i in range(count):
                    x = start + i
                    difference = np.float32(3) * (logs[side, y, x] - logs[2, y, x])
                    run[4 + side, i] = min(max(difference, np.float32(-3)), np.float32(3))
                    run[6 + side, i] = rings[3 + side, y, x] * np.float32(0.0625) - _ONE
            for c in range(INPUTS):
                for side in range(2):
                    channel = 4 * c + 2 * (y % 2) + side
                    for i in range(count // 2):
                        out[y // 2, start // 2 + i, channel] = run[c, 2 * i + side]


@njit(inline="always")
def _gather(head, y, start, count, weights, depths):  # type: ignore[no-untyped-def]
    """Logits and corrections of `count` pixels of row y from column `start` (even): undoes the pixel shuffle."""
    corner = 2 * (y % 2)
    row = head[y // 2, start // 2 : (start + count) // 2]
    if head.strides[2] == head.itemsize:  # torch: the channels of a pixel lie together
        for i in range(len(row)):
            for k in range(CANDIDATES):
                for side in range(2):
                    weights[k, 2 * i + side] = row[i, 4 * k + corner + side]
                    depths[k, 2 * i + side] = row[i, 4 * (CANDIDATES + k) + corner + side]
        return
    for k in range(CANDIDATES):  # ONNX Runtime: the pixels of a channel do
        for side in range(2):
            for i in range(len(row)):
                weights[k, 2 * i + side] = row[i, 4 * k + corner + side]
                depths[k, 2 * i + side] = row[i, 4 * (CANDIDATES + k) + corner + side]


@njit(inline="always")
def _candidates(logs, y, start, shifts, residual, depths):  # type: ignore[no-untyped-def]
    """Corrections (K, n), in place -> natural logarithms of the candidates' depths."""
    width = logs.shape[2]
    for s in range(len(shifts)):
        for r in range(3):
            own = depths[3 * s + r]
            for i in range(_RUN):
                tanh = _ONE - _TWO / (_exp(_TWO * own[i]) + _ONE)
                own[i] = residual * tanh
            for i in range(_RUN):
                own[i] += logs[r, y, min(max(start + i + shifts[s], 0), width - 1)]
    for i in range(_RUN):
        depths[_MEASURED, i] += logs[2, y, min(start + i, width - 1)]


@njit(inline="always")
def _softmax(weights, top):  # type: ignore[no-untyped-def]
    for i in range(_RUN):
        top[i] = weights[0, i]
    for k in range(1, CANDIDATES):
        for i in range(_RUN):
            top[i] = weights[k, i] if weights[k, i] > top[i] else top[i]
    for k in range(CANDIDATES):
        for i in range(_RUN):
            weights[k, i] = _exp(weights[k, i] - top[i])
    top[:] = _ZERO
    for k in range(CANDIDATES):
        for i in range(_RUN):
            top[i] += weights[k, i]
    for i in range(_RUN):
        top[i] = _ONE / top[i]
    for k in range(CANDIDATES):
        for i in range(_RUN):
            weights[k, i] *= top[i]


@njit(inline="always")
def _cumulate(weights, depths, cumulated):  # type: ignore[no-untyped-def]
    """cumulated[k]: the weight of all candidates not behind candidate k. Comparing all pairs needs no branch, unlike
    sorting; twice as many comparisons as needed, but only one sum is written, at the end."""
    for k in range(CANDIDATES):
        for i in range(_RUN):
            total = _ZERO
            for j in range(CANDIDATES):
                total += weights[j, i] if depths[j, i] <= depths[k, i] else _ZERO
            cumulated[k, i] = total


@njit(inline="always")
def _quantile(depths, cumulated, share, out):  # type: ignore[no-untyped-def]
    """The nearest candidate whose cumulated weight reaches the share."""
    out[:] = np.float32(np.inf)
    for k in range(CANDIDATES):
        for i in range(_RUN):
            reached = depths[k, i] if cumulated[k, i] >= share else np.float32(np.inf)
            out[i] = reached if reached < out[i] else out[i]


@njit(inline="always")
def _distribution(weights, depths, cumulated, found, logs, y, start, shifts, residual, shares):  # type: ignore[no-untyped-def]
    """Logits and corrections of a run of pixels -> weights, log depths, and found (4, n): log depth of foreground,
    median and background, weight of the foreground."""
    _candidates(logs, y, start, shifts, residual, depths)
    _softmax(weights, found[0])
    _cumulate(weights, depths, cumulated)
    for s in range(3):
        _quantile(depths, cumulated, shares[s], found[s])
    found[3] = _ZERO
    for k in range(CANDIDATES):
        for i in range(_RUN):
            nearer = depths[k, i] <= _HALF * (found[0, i] + found[2, i])
            found[3, i] += weights[k, i] if nearer else _ZERO


@njit(inline="always")
def _write_run(weights, depths, cumulated, found, expected, y, start, out):  # type: ignore[no-untyped-def]
    """Metres of a run of pixels from what `_distribution` found; see `_read_rows`."""
    if expected:
        cumulated[0] = _ZERO
        for k in range(CANDIDATES):
            for i in range(_RUN):
                cumulated[0, i] += weights[k, i] * _exp(depths[k, i])
    for i in range(_RUN):
        cumulated[1, i] = _exp(found[1, i])
        found[0, i] = _exp(found[0, i])
        found[2, i] = _exp(found[2, i])
    for i in range(min(_RUN, out.shape[2] - start)):
        out[0, y, start + i] = cumulated[0, i] if expected else cumulated[1, i]
        out[1, y, start + i] = found[0, i]
        out[2, y, start + i] = found[2, i]
        out[3, y, start + i] = found[3, i] if found[3, i] < _ONE else _ONE


@njit(cache=True, nogil=True, error_model="numpy")
def _read_rows(first, last, head, logs, top, shifts, residual, shares, expected, out):  # type: ignore[no-untyped-def]
    """Rows first..last of out (4, h, w): depth, foreground, background, sigma.

    head (H/2, W/2, 84), logs (3, H, W); the image begins at row `top`; shares of foreground, median, background;
    depth is the mean when `expected`, else the median.
    """
    weights, depths = np.zeros((CANDIDATES, _RUN), np.float32), np.zeros((CANDIDATES, _RUN), np.float32)
    cumulated, found = np.empty((CANDIDATES, _RUN), np.float32), np.empty((4, _RUN), np.float32)
    for y in range(first, last):
        for start in range(0, out.shape[2], _RUN):
            _gather(head, y + top, start, min(_RUN, logs.shape[2] - start), weights, depths)
            _distribution(weights, depths, cumulated, found, logs, y + top, start, shifts, residual, shares)
            _write_run(weights, depths, cumulated, found, expected, y, start, out)


@njit(cache=True, nogil=True, error_model="numpy")
def _read_features(first, last, features, kernels, bias, logs, top, shifts, residual, shares, expected, out):  # type: ignore[no-untyped-def]
    """`_read_rows` from what the head convolves: features (H/2, W/2, C), see `PixelUNetKernels`.

    The head is by far the largest map; here no more of it exists than a run of pixels takes.
    """
    weights, depths = np.zeros((CANDIDATES, _RUN), np.float32), np.zeros((CANDIDATES, _RUN), np.float32)
    cumulated, found = np.empty((CANDIDATES, _RUN), np.float32), np.empty((4, _RUN), np.float32)
    rectified = np.empty((_RUN // 2, features.shape[2]), np.float32)
    head = np.empty((_RUN // 2, 4 * CANDIDATES), np.float32)
    for y in range(first, last):
        source, side = (y + top) // 2, (y + top) % 2
        for start in range(0, out.shape[2], _RUN):
            count = min(_RUN, logs.shape[2] - start) // 2
            for i in range(count):
                for c in range(features.shape[2]):
                    rectified[i, c] = max(features[source, start // 2 + i, c], _ZERO)
            multiply(rectified[:count], kernels[side], head[:count])
            for k in range(CANDIDATES):
                for c in range(2):
                    a, b = 2 * k + c, 2 * (CANDIDATES + k) + c
                    for i in range(count):
                        weights[k, 2 * i + c] = head[i, a] + bias[side, a]
                        depths[k, 2 * i + c] = head[i, b] + bias[side, b]
            _distribution(weights, depths, cumulated, found, logs, y + top, start, shifts, residual, shares)
            _write_run(weights, depths, cumulated, found, expected, y, start, out)


def _in_threads(kernel: Callable[..., None], rows: int, *arguments: object) -> None:
    """kernel(first, last, ...) over all rows, in as many threads as torch uses."""
    threads = max(1, min(torch.get_num_threads(), rows))
    if threads == 1:
        kernel(0, rows, *arguments)
        return
    edges = [rows * part // threads for part in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(kernel, a, b, *arguments) for a, b in itertools.pairwise(edges)]:
            done.result()


def _rings(sparse: Float) -> tuple[Float, Float]:
    """`rings.enclose` (5, H, W) and the natural logarithms of its depths (3, H, W), with as many threads as torch."""
    rings = np.empty((5, *sparse.shape), np.float32)
    logs = np.empty((3, *sparse.shape), np.float32)
    sides = ((sparse, rings[0], rings[3]), (sparse[::-1], rings[1, ::-1], rings[4, ::-1]))

    def sweep_sides(first: int, last: int) -> None:
        for side in sides[first:last]:
            sweep(*side)

    def finish_rows(first: int, last: int) -> None:
        interpolate_rows(first, last, rings)
        np.log(rings[:3, first:last], out=logs[:, first:last])

    _in_threads(sweep_sides, 2)
    _in_threads(finish_rows, len(sparse))
    return rings, logs


def complete_mixture(
    model: Selection,
    convolutions: Callable[[Tensor], Tensor] | None,
    sparse: Float,
    image: NDArray[np.uint8],
    scaling: str,
    read_out: str,
) -> tuple[Float, Float, Float, Float]:
    """Sparse (h, w) metres and image (h, w, 3) of any size -> depth, foreground, background, sigma, each (h, w).

    convolutions  (1, 40, H/2, W/2) -> (1, 84, H/2, W/2), an export of `model.network.at_half` or our kernels; None:
                  that itself
    scaling       of the colours, see `inputs.scale_rgb`
    read_out      one of `readout.MIXTURE_READ_OUTS`
    """
    height, width = sparse.shape
    top, right = -height % 32, -width % 32
    padded = np.pad(sparse, ((top, 0), (0, right)))
    pixels = np.pad(image, ((top, 0), (0, right), (0, 0)), mode="edge")
    rings, logs = _rings(padded)
    levels = torch.arange(256, dtype=torch.float32).expand(1, 3, 1, 256)
    colours = scale_rgb(levels, scaling)[0, :, 0].contiguous().numpy()
    half = (padded.shape[0] // 2, padded.shape[1] // 2)
    if convolutions is None or isinstance(convolutions, PixelUNetKernels):
        features = np.empty((*half, 4 * INPUTS), np.float32)  # the channels of a pixel together; exports take planes
    else:
        features = np.empty((4 * INPUTS, *half), np.float32).transpose(1, 2, 0)
    _in_threads(_write_inputs, half[0], pixels, colours, padded, rings, logs, features)
    low, high = surface_shares(GAMMA)
    shares = np.array((low, 0.5, high), np.float32)
    out = np.empty((4, height, width), np.float32)
    common = logs, top, np.array(COLUMN_SHIFTS), np.float32(model.residual), shares, read_out == "expected", out
    if isinstance(convolutions, PixelUNetKernels):
        with convolutions.lock:
            _in_threads(_read_features, height, convolutions.before_head(features), *convolutions.head, *common)
    else:
        run = convolutions or model.network.at_half
        head = run(torch.from_numpy(features).permute(2, 0, 1)[None])
        assert head.shape[1] == 4 * CHANNELS, head.shape
        _in_threads(_read_rows, height, head[0].float().permute(1, 2, 0).numpy(), *common)
    depth, foreground, background, sigma = out
    if read_out not in ("median", "expected"):
        depth = fuse(foreground, background, sigma, read_out)
    return depth, foreground, background, sigma
