"""`ring_coefficients.RingCoefficients` for inference on the CPU: the same depth, much faster.

The torch version writes three dense maps of 82 coefficients and the softmax of their sum. Here a run of pixels has its
logits once, in the first-level cache; rings touch nine of them at most.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from completion.cpu.border import require
from completion.cpu.pixel_unet import Head, PixelUNetKernels, head_of
from completion.cpu.unet_inputs import Float, in_threads, unet_inputs
from completion.cpu.vector_exp import exp
from completion.decoding import require_decoding
from completion.executors import FrameMaps
from completion.models import ModelSpec
from completion.models.ring_coefficients import FLOOR, RingCoefficients

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


class RingLogits(NamedTuple):
    """What is added to the network's logits: rings (5, H, W) of a frame padded by `top` rows, see `UNetInputs`; and the
    bins: their size in metres and their number."""

    rings: Float
    top: int
    size: np.float32
    channels: int


@njit(cache=True, nogil=True, error_model="numpy")
def _read_features(first, last, features, head_layer, added, peak, out):  # type: ignore[no-untyped-def]
    """Rows first..last of out (h, w) from what the head convolves: features (H/2, W/2, C), see `PixelUNetKernels`.

    head_layer, added  `pixel_unet.Head` and `RingLogits`
    """
    kernels, bias = head_layer
    rings, top, size, channels = added
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


def read_coefficients(features: Float, head: Head, added: RingLogits, peak: bool, out: Float) -> None:
    """Writes depth (h, w) to `out`, in as many threads as torch uses; see `_read_features`.

    peak  expectation over the largest coefficient and its neighbours, else over all
    ValueError for maps of other shapes or types than these.
    """
    _, height, width = require("rings", added.rings, (5, None, None))
    outputs = require("head weights", head.weights, (2, features.shape[-1], None))[2]
    require("features", features, (height // 2, width // 2, None))
    require("head biases", head.bias, (2, outputs))
    rows, columns = require("depth", out, (None, None))
    if (
        2 * added.channels > outputs
        or rows + added.top > height
        or columns > width
        or min(added.channels - 3, added.top) < 0
    ):
        raise ValueError(
            f"coefficients: {outputs} outputs of the head and rings {height} x {width} do not hold {added.channels} "
            f"bins and a depth map {rows} x {columns} from row {added.top} on"
        )
    in_threads(_read_features, rows, features, head, added, peak, out)


class WinogradCoefficients:
    """`executors.Executor` of a ring-coefficients network with its weights at the time of this call.

    ValueError for a decoding other than "all" and "peak", see `depth_coefficients.decode`.
    """

    def __init__(self, model: RingCoefficients, spec: ModelSpec, decoding: str) -> None:
        require_decoding(spec, decoding)
        self.kernels, self.bins, self.scaling = PixelUNetKernels(model.network), spec.bins, spec.rgb
        self.peak = decoding == "peak"

    def run(self, sparse: Float, rgb: NDArray[np.uint8]) -> FrameMaps:
        """See `Executor`."""
        inputs = unet_inputs(sparse, rgb, self.scaling, planes=False)
        added = RingLogits(inputs.rings, inputs.top, np.float32(self.bins.size), self.bins.channels)
        depth = np.empty(sparse.shape, np.float32)
        with self.kernels.lock:
            read_coefficients(self.kernels.before_head(inputs.features), self.kernels.head, added, self.peak, depth)
        return FrameMaps(depth)
