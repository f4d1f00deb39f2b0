"""`ring_coefficients.RingCoefficients` for inference on the CPU: the same depth, much faster.

The torch version writes three dense maps of 82 coefficients and the softmax of their sum. Here a run of pixels has its
logits once, in the first-level cache; rings touch nine of them at most.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from completion.cpu.pixel_unet import PixelUNetKernels, head_of
from completion.cpu.unet_inputs import Float, in_threads, unet_inputs
from completion.cpu.vector_exp import exp
from completion.depth_coefficients import Bins
from completion.models.ring_coefficients import FLOOR

_RUN = 64  # pixels: their logits take 21 KB
_ZERO, _HALF = np.float32(0), np.float32(0.5)
# A ring's coefficient is a third of the code's, and logits may all be shifted: bins without one by -log(FLOOR) to 0.
_SCALE = np.float32(1 / (3 * FLOOR))


@njit(inline="always")
def _add_rings(rings, y, start, count, size, last_bin, code, logits):  # type: ignore[no-untyped-def]
    """Adds log(1 + coefficient / FLOOR) of the three rings to the logits (channels, n); code (channels,) is all 0."""
    for i in range(count):
        for ring in range(3):
            scaled = min(rings[ring, y, start + i] / size, np.float32(last_bin))
            nearest = int(np.rint(scaled))
            if nearest >= 1:
                delta = scaled - np.float32(nearest)
                code[nearest - 1] += _HALF * (_HALF - delta)
                code[nearest] += _HALF
                code[nearest + 1] += _HALF * (_HALF + delta)
        for ring in range(3):
            nearest = int(np.rint(min(rings[ring, y, start + i] / size, np.float32(last_bin))))
            for channel in range(max(nearest - 1, 0), nearest + 2):
                # Zero after its first use: bins that rings share are added once.
                if code[channel] > _ZERO:
                    logits[channel, i] += math.log(np.float32(1) + code[channel] * _SCALE)
                    code[channel] = _ZERO


@njit(inline="always")
def _decode(logits, size, peak, top, where, out):  # type: ignore[no-untyped-def]
    """Logits (channels, n) -> depth (n,): expectation over all bins, or over the first largest and its neighbours."""
    channels = len(logits)
    top[:] = logits[0]
    where[:] = 0
    for c in range(1, channels):
        for i in range(_RUN):
            larger = logits[c, i] > top[i]
            where[i] = c if larger else where[i]
            top[i] = logits[c, i] if larger else top[i]
    for i in range(len(out)):
        middle = min(max(where[i], 1), channels - 2)
        low, high = (middle - 1, middle + 2) if peak else (0, channels)
        total, moment = _ZERO, _ZERO
        for c in range(low, high):
            weight = exp(logits[c, i] - top[i])
            total += weight
            moment += weight * np.float32(c)
        out[i] = size * moment / total


@njit(cache=True, nogil=True, error_model="numpy")
def _read_features(first, last, features, kernels, bias, rings, top, size, channels, peak, out):  # type: ignore[no-untyped-def]
    """Rows first..last of out (h, w) from what the head convolves: features (H/2, W/2, C), see `PixelUNetKernels`."""
    logits, code = np.zeros((channels, _RUN), np.float32), np.zeros(channels, np.float32)
    largest, where = np.empty(_RUN, np.float32), np.empty(_RUN, np.int32)
    rectified = np.empty((_RUN // 2, features.shape[2]), np.float32)
    head = np.empty((_RUN // 2, kernels.shape[2]), np.float32)
    for y in range(first, last):
        source, side = (y + top) // 2, (y + top) % 2
        for start in range(0, out.shape[1], _RUN):
            count = min(_RUN, rings.shape[2] - start) // 2
            head_of(features[source], start // 2, kernels[side], rectified[:count], head[:count])
            for c in range(channels):
                for column in range(2):
                    for i in range(count):
                        logits[c, 2 * i + column] = head[i, 2 * c + column] + bias[side, 2 * c + column]
            _add_rings(rings, y + top, start, 2 * count, size, channels - 2, code, logits)
            _decode(logits, size, peak, largest, where, out[y, start : start + _RUN])


def complete_coefficients(
    bins: Bins, convolutions: PixelUNetKernels, sparse: Float, image: NDArray[np.uint8], scaling: str, decoding: str
) -> Float:
    """Sparse (h, w) metres and image (h, w, 3) of any size -> depth (h, w).

    bins      with guard bins
    scaling   of the colours, see `inputs.scale_rgb`
    decoding  "all" or "peak", see `depth_coefficients.decode`
    """
    inputs = unet_inputs(sparse, image, scaling, planes=False)
    depth = np.empty(sparse.shape, np.float32)
    shape = np.float32(bins.size), bins.channels, decoding == "peak"
    with convolutions.lock:
        hidden = convolutions.before_head(inputs.features)
        in_threads(_read_features, len(sparse), hidden, *convolutions.head, inputs.rings, inputs.top, *shape, depth)
    return depth
