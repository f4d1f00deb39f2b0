"""What follows the convolutions of `selection.Selection`, for inference on the CPU: the same values, much faster.

One pass over the image with numba instead of some eighty tensor operations, on runs of pixels of one row that fit the
first-level cache, in plain loops the compiler turns into vector instructions. Rows are shared among as many threads as
torch uses.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from completion.cpu.pixel_unet import PixelUNetKernels, head_of
from completion.cpu.unet_inputs import RUN, in_threads, unet_inputs
from completion.cpu.vector_exp import exp
from completion.mixture import surface_shares
from completion.models.selection import CANDIDATES, CHANNELS, COLUMN_SHIFTS, Selection
from completion.twin_surface import fuse

Float = NDArray[np.float32]
GAMMA = 2.0
_MEASURED = CANDIDATES - 1
_ONE, _TWO, _HALF, _ZERO = np.float32(1), np.float32(2), np.float32(0.5), np.float32(0)


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
            for i in range(RUN):
                tanh = _ONE - _TWO / (exp(_TWO * own[i]) + _ONE)
                own[i] = residual * tanh
            for i in range(RUN):
                own[i] += logs[r, y, min(max(start + i + shifts[s], 0), width - 1)]
    for i in range(RUN):
        depths[_MEASURED, i] += logs[2, y, min(start + i, width - 1)]


@njit(inline="always")
def _softmax(weights, top):  # type: ignore[no-untyped-def]
    for i in range(RUN):
        top[i] = weights[0, i]
    for k in range(1, CANDIDATES):
        for i in range(RUN):
            top[i] = weights[k, i] if weights[k, i] > top[i] else top[i]
    for k in range(CANDIDATES):
        for i in range(RUN):
            weights[k, i] = exp(weights[k, i] - top[i])
    top[:] = _ZERO
    for k in range(CANDIDATES):
        for i in range(RUN):
            top[i] += weights[k, i]
    for i in range(RUN):
        top[i] = _ONE / top[i]
    for k in range(CANDIDATES):
        for i in range(RUN):
            weights[k, i] *= top[i]


@njit(inline="always")
def _cumulate(weights, depths, cumulated):  # type: ignore[no-untyped-def]
    """cumulated[k]: the weight of all candidates not behind candidate k. Comparing all pairs needs no branch, unlike
    sorting; twice as many comparisons as needed, but only one sum is written, at the end."""
    for k in range(CANDIDATES):
        for i in range(RUN):
            total = _ZERO
            for j in range(CANDIDATES):
                total += weights[j, i] if depths[j, i] <= depths[k, i] else _ZERO
            cumulated[k, i] = total


@njit(inline="always")
def _quantile(depths, cumulated, share, out):  # type: ignore[no-untyped-def]
    """The nearest candidate whose cumulated weight reaches the share."""
    out[:] = np.float32(np.inf)
    for k in range(CANDIDATES):
        for i in range(RUN):
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
        for i in range(RUN):
            nearer = depths[k, i] <= _HALF * (found[0, i] + found[2, i])
            found[3, i] += weights[k, i] if nearer else _ZERO


@njit(inline="always")
def _write_run(weights, depths, cumulated, found, expected, y, start, out):  # type: ignore[no-untyped-def]
    """Metres of a run of pixels from what `_distribution` found; see `_read_rows`."""
    if expected:
        cumulated[0] = _ZERO
        for k in range(CANDIDATES):
            for i in range(RUN):
                cumulated[0, i] += weights[k, i] * exp(depths[k, i])
    for i in range(RUN):
        cumulated[1, i] = exp(found[1, i])
        found[0, i] = exp(found[0, i])
        found[2, i] = exp(found[2, i])
    for i in range(min(RUN, out.shape[2] - start)):
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
    weights, depths = np.zeros((CANDIDATES, RUN), np.float32), np.zeros((CANDIDATES, RUN), np.float32)
    cumulated, found = np.empty((CANDIDATES, RUN), np.float32), np.empty((4, RUN), np.float32)
    for y in range(first, last):
        for start in range(0, out.shape[2], RUN):
            _gather(head, y + top, start, min(RUN, logs.shape[2] - start), weights, depths)
            _distribution(weights, depths, cumulated, found, logs, y + top, start, shifts, residual, shares)
            _write_run(weights, depths, cumulated, found, expected, y, start, out)


@njit(cache=True, nogil=True, error_model="numpy")
def _read_features(first, last, features, kernels, bias, logs, top, shifts, residual, shares, expected, out):  # type: ignore[no-untyped-def]
    """`_read_rows` from what the head convolves: features (H/2, W/2, C), see `PixelUNetKernels`.

    The head is by far the largest map; here no more of it exists than a run of pixels takes.
    """
    weights, depths = np.zeros((CANDIDATES, RUN), np.float32), np.zeros((CANDIDATES, RUN), np.float32)
    cumulated, found = np.empty((CANDIDATES, RUN), np.float32), np.empty((4, RUN), np.float32)
    rectified = np.empty((RUN // 2, features.shape[2]), np.float32)
    head = np.empty((RUN // 2, 4 * CANDIDATES), np.float32)
    for y in range(first, last):
        source, side = (y + top) // 2, (y + top) % 2
        for start in range(0, out.shape[2], RUN):
            count = min(RUN, logs.shape[2] - start) // 2
            head_of(features[source], start // 2, kernels[side], rectified[:count], head[:count])
            for k in range(CANDIDATES):
                for c in range(2):
                    a, b = 2 * k + c, 2 * (CANDIDATES + k) + c
                    for i in range(count):
                        weights[k, 2 * i + c] = head[i, a] + bias[side, a]
                        depths[k, 2 * i + c] = head[i, b] + bias[side, b]
            _distribution(weights, depths, cumulated, found, logs, y + top, start, shifts, residual, shares)
            _write_run(weights, depths, cumulated, found, expected, y, start, out)


def complete_mixture(
    model: Selection,
    convolutions: Callable[[Tensor], Tensor] | None,
    sparse: Float,
    image: NDArray[np.uint8],
    scaling: str,
    decoding: str,
) -> tuple[Float, Float, Float, Float]:
    """Sparse (h, w) metres and image (h, w, 3) of any size -> depth, foreground, background, sigma, each (h, w).

    convolutions  (1, 40, H/2, W/2) -> (1, 84, H/2, W/2), an export of `model.network.at_half` or our kernels; None:
                  that itself
    scaling       of the colours, see `inputs.scale_rgb`
    decoding      one of `completion.decoding.MIXTURE_DECODINGS`
    """
    own = isinstance(convolutions, PixelUNetKernels)
    inputs = unet_inputs(sparse, image, scaling, planes=convolutions is not None and not own)
    low, high = surface_shares(GAMMA)
    shares = np.array((low, 0.5, high), np.float32)
    out = np.empty((4, *sparse.shape), np.float32)
    shifts, residual = np.array(COLUMN_SHIFTS), np.float32(model.residual)
    common = inputs.logs, inputs.top, shifts, residual, shares, decoding == "expected", out
    if isinstance(convolutions, PixelUNetKernels):
        with convolutions.lock:
            hidden = convolutions.before_head(inputs.features)
            in_threads(_read_features, len(sparse), hidden, *convolutions.head, *common)
    else:
        run = convolutions or model.network.at_half
        head = run(torch.from_numpy(inputs.features).permute(2, 0, 1)[None])
        assert head.shape[1] == 4 * CHANNELS, head.shape
        in_threads(_read_rows, len(sparse), head[0].float().permute(1, 2, 0).numpy(), *common)
    depth, foreground, background, sigma = out
    if decoding not in ("median", "expected"):
        depth = fuse(foreground, background, sigma, decoding)
    return depth, foreground, background, sigma
