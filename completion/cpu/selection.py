"""What follows the convolutions of `selection.Selection`, for inference on the CPU: the same values, much faster.

One pass over the image with numba instead of some eighty tensor operations, on runs of pixels of one row that fit the
first-level cache, in plain loops the compiler turns into vector instructions. Rows are shared among as many threads as
torch uses.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from completion.cpu.border import require
from completion.cpu.pixel_unet import Head, PixelUNetKernels, head_of
from completion.cpu.unet_inputs import RUN, UNetInputs, in_threads, unet_inputs
from completion.cpu.vector_exp import exp
from completion.decoding import require_decoding
from completion.executors import FrameMaps
from completion.mixture import surface_shares
from completion.models import ModelSpec
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


class Candidates(NamedTuple):
    """What the weights and corrections of a frame refer to.

    logs      (3, H, W) of a frame padded by `top` rows, see `UNetInputs`
    shifts    (S,) int64 columns
    residual  see `Selection`
    shares    (3,) of foreground, median and background
    """

    logs: Float
    top: int
    shifts: NDArray[np.int64]
    residual: np.float32
    shares: Float


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
def _read_rows(first, last, head, candidates, expected, out):  # type: ignore[no-untyped-def]
    """Rows first..last of out (4, h, w): depth, foreground, background, sigma.

    head (H/2, W/2, 84); depth is the mean when `expected`, else the median.
    """
    weights, depths = np.zeros((CANDIDATES, RUN), np.float32), np.zeros((CANDIDATES, RUN), np.float32)
    cumulated, found = np.empty((CANDIDATES, RUN), np.float32), np.empty((4, RUN), np.float32)
    logs, top, shifts, residual, shares = candidates  # once: a field read in the loops costs 4 % of a frame
    width = logs.shape[2]
    for y in range(first, last):
        for start in range(0, out.shape[2], RUN):
            _gather(head, y + top, start, min(RUN, width - start), weights, depths)
            _distribution(weights, depths, cumulated, found, logs, y + top, start, shifts, residual, shares)
            _write_run(weights, depths, cumulated, found, expected, y, start, out)


@njit(cache=True, nogil=True, error_model="numpy")
def _read_features(first, last, features, head_layer, candidates, expected, out):  # type: ignore[no-untyped-def]
    """`_read_rows` from what the head convolves: features (H/2, W/2, C), see `PixelUNetKernels`.

    The head is by far the largest map; here no more of it exists than a run of pixels takes.
    """
    weights, depths = np.zeros((CANDIDATES, RUN), np.float32), np.zeros((CANDIDATES, RUN), np.float32)
    cumulated, found = np.empty((CANDIDATES, RUN), np.float32), np.empty((4, RUN), np.float32)
    rectified = np.empty((RUN // 2, features.shape[2]), np.float32)
    head = np.empty((RUN // 2, 4 * CANDIDATES), np.float32)
    kernels, bias = head_layer
    logs, top, shifts, residual, shares = candidates  # once: a field read in the loops costs 4 % of a frame
    width = logs.shape[2]
    for y in range(first, last):
        source, side = (y + top) // 2, (y + top) % 2
        for start in range(0, out.shape[2], RUN):
            count = min(RUN, width - start) // 2
            head_of(features[source], start // 2, kernels[side], rectified[:count], head[:count])
            for k in range(CANDIDATES):
                for c in range(2):
                    a, b = 2 * k + c, 2 * (CANDIDATES + k) + c
                    for i in range(count):
                        weights[k, 2 * i + c] = head[i, a] + bias[side, a]
                        depths[k, 2 * i + c] = head[i, b] + bias[side, b]
            _distribution(weights, depths, cumulated, found, logs, y + top, start, shifts, residual, shares)
            _write_run(weights, depths, cumulated, found, expected, y, start, out)


def read_mixture(head: Float, candidates: Candidates, expected: bool, out: Float) -> None:
    """Writes out (4, h, w), in as many threads as torch uses; see `_read_rows`. ValueError for maps of other shapes or
    types."""
    rows = _require_candidates(candidates, out)
    height, width = candidates.logs.shape[1:]
    require("head", head, (height // 2, width // 2, 4 * CHANNELS))
    in_threads(_read_rows, rows, head, candidates, expected, out)


def read_mixture_of_features(features: Float, head: Head, candidates: Candidates, expected: bool, out: Float) -> None:
    """`read_mixture` with the last layer `head`, of 2 CANDIDATES outputs, still to be applied to `features`."""
    rows = _require_candidates(candidates, out)
    height, width = candidates.logs.shape[1:]
    require("features", features, (height // 2, width // 2, None))
    require("head weights", head.weights, (2, features.shape[2], 4 * CANDIDATES))
    require("head biases", head.bias, (2, 4 * CANDIDATES))
    in_threads(_read_features, rows, features, head, candidates, expected, out)


def _require_candidates(candidates: Candidates, out: Float) -> int:
    """How many rows `out` has."""
    _, rows, columns = require("maps", out, (4, None, None))
    _, height, width = require("logs", candidates.logs, (3, None, None))
    require("shares", candidates.shares, (3,))
    if candidates.shifts.shape != (len(COLUMN_SHIFTS),):
        raise ValueError(f"shifts: expected {len(COLUMN_SHIFTS)} columns, got shape {candidates.shifts.shape}")
    if rows + candidates.top > height or columns > width or candidates.top < 0:
        raise ValueError(f"maps: {rows} x {columns} from row {candidates.top} on exceed the logs' {height} x {width}")
    return rows


class _SelectionExecutor:
    """What both executors of a selection network share; see `executors.Executor`."""

    def __init__(self, model: Selection, spec: ModelSpec, decoding: str) -> None:
        require_decoding(spec, decoding)
        self.residual, self.scaling, self.decoding = np.float32(model.residual), spec.rgb, decoding
        low, high = surface_shares(GAMMA)
        self.shares = np.array((low, 0.5, high), np.float32)

    def _candidates(self, inputs: UNetInputs) -> Candidates:
        return Candidates(inputs.logs, inputs.top, np.array(COLUMN_SHIFTS), self.residual, self.shares)

    def _maps(self, read: Float) -> FrameMaps:
        depth, foreground, background, sigma = read
        if self.decoding not in ("median", "expected"):
            depth = fuse(foreground, background, sigma, self.decoding)
        return FrameMaps(depth, foreground, background, sigma)


class FusedSelection(_SelectionExecutor):
    """Convolutions by torch or by an export, all around them fused.

    at_half   (1, 40, H/2, W/2) -> (1, 84, H/2, W/2): `model.network.at_half` or what computes the same
    decoding  one of `completion.decoding.MIXTURE_DECODINGS`, else ValueError
    planes    the pixels of a channel lie together in what `at_half` is given, as exports take it
    """

    def __init__(
        self,
        model: Selection,
        spec: ModelSpec,
        decoding: str,
        at_half: Callable[[Tensor], Tensor],
        planes: bool = False,
    ) -> None:
        super().__init__(model, spec, decoding)
        self.at_half, self.planes = at_half, planes

    def run(self, sparse: Float, rgb: NDArray[np.uint8]) -> FrameMaps:
        """See `Executor`."""
        inputs = unet_inputs(sparse, rgb, self.scaling, self.planes)
        with torch.inference_mode():
            head = self.at_half(torch.from_numpy(inputs.features).permute(2, 0, 1)[None])[0].float()
        out = np.empty((4, *sparse.shape), np.float32)
        rows = head.permute(1, 2, 0).numpy()
        read_mixture(rows, self._candidates(inputs), self.decoding == "expected", out)
        return self._maps(out)


class WinogradSelection(_SelectionExecutor):
    """Our convolutions, with the network's weights at the time of this call; the last layer is fused too."""

    def __init__(self, model: Selection, spec: ModelSpec, decoding: str) -> None:
        super().__init__(model, spec, decoding)
        self.kernels = PixelUNetKernels(model.network, outputs=2 * CANDIDATES)  # no decoding needs the scale

    def run(self, sparse: Float, rgb: NDArray[np.uint8]) -> FrameMaps:
        """See `Executor`."""
        inputs = unet_inputs(sparse, rgb, self.scaling, planes=False)
        out = np.empty((4, *sparse.shape), np.float32)
        candidates, expected = self._candidates(inputs), self.decoding == "expected"
        with self.kernels.lock:
            features = self.kernels.before_head(inputs.features)
            read_mixture_of_features(features, self.kernels.head, candidates, expected, out)
        return self._maps(out)
