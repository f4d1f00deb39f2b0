"""The deformable operations of NLSPN (`completion.models.deformable`) for inference on the CPU: the same, faster.

The torch version reads an index and a factor for each of the 32 corners of a pixel from memory in every iteration; here
a row's positions are computed anew from 16 offsets.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from completion.cpu.border import require
from completion.cpu.row_threads import RowThreads
from completion.executors import Forward
from completion.models.nlspn import NLSPN, Operations

Float = NDArray[np.float32]

_ZERO, _ONE = np.float32(0), np.float32(1)


@njit(inline="always")
def _add_samples(values, stride, size, corner, offset, weight, out):  # type: ignore[no-untyped-def]
    """out (W,) += weight (W,) times the bilinear sample of a bordered flat map at corner + (0, x) + offset (2, W).

    size  (H, W) as float32; corner  (row, column) of the first sample's place as float32
    """
    height, width = size
    row, column = corner
    for x in range(len(out)):
        # A NaN fails both comparisons and ends at the border, where all is 0.
        y = min(max(row + offset[0, x], -_ONE), height)
        z = min(max(column + np.float32(x) + offset[1, x], -_ONE), width)
        y = y if y >= -_ONE else -_ONE
        z = z if z >= -_ONE else -_ONE
        top, left = np.floor(y), np.floor(z)
        down, right = y - top, z - left
        first = np.uint32((np.int32(top) + np.int32(1)) * stride + np.int32(left) + np.int32(1))
        below = np.uint32(first + np.uint32(stride))
        upper = values[first] * (_ONE - right) + values[np.uint32(first + np.uint32(1))] * right
        lower = values[below] * (_ONE - right) + values[np.uint32(below + np.uint32(1))] * right
        out[x] += weight[x] * (upper * (_ONE - down) + lower * down)


@njit(cache=True, nogil=True, error_model="numpy")
def _propagate_rows(first, last, values, kept, offsets, weights, out):  # type: ignore[no-untyped-def]
    """Rows first..last of one iteration: bordered values (H + 3, W + 3) -> the inside of out.

    kept  (H, W); where it is > 0, out gets it in place of the iteration's value (for the next iteration)
    """
    taps, height, width = weights.shape
    kernel = int(np.sqrt(np.float64(taps)) + 0.5)
    flat, stride = values.ravel(), np.int32(values.shape[1])
    size = (np.float32(height), np.float32(width))
    for y in range(first, last):
        total = out[y + 1, 1 : width + 1]
        for x in range(width):
            total[x] = weights[taps // 2, y, x] * values[y + 1, x + 1]
        for tap in range(taps):
            if tap != taps // 2:
                corner = (np.float32(y + tap // kernel - kernel // 2), np.float32(tap % kernel - kernel // 2))
                _add_samples(flat, stride, size, corner, offsets[tap, :, y], weights[tap, y], total)
        for x in range(width):
            total[x] = kept[y, x] if kept[y, x] > _ZERO else total[x]


@njit(cache=True, nogil=True, error_model="numpy")
def _confidence_rows(first, last, values, offsets, affinities, out):  # type: ignore[no-untyped-def]
    """Rows first..last of out (n, H, W) = affinities times bordered values at p + offset."""
    taps, height, width = affinities.shape
    flat, stride = values.ravel(), np.int32(values.shape[1])
    size = (np.float32(height), np.float32(width))
    for y in range(first, last):
        for tap in range(taps):
            out[tap, y] = _ZERO
            corner = (np.float32(y), _ZERO)
            _add_samples(flat, stride, size, corner, offsets[tap, :, y], affinities[tap, y], out[tap, y])


def _bordered(values: Float) -> Float:
    return np.pad(values, ((1, 2), (1, 2)))


def propagated(
    depth: Float, offsets: Float, weights: Float, iterations: int, kept: Float | None, threads: RowThreads
) -> Float:
    """The map (H, W) after the iterations.

    offsets  (K^2, 2, H, W), pixels; weights (K^2, H, W); kept (H, W) or None; see `deformable.propagate`
    ValueError for arrays of other shapes or types than these.
    """
    height, width = require("depth", depth, (None, None))
    taps = require("weights", weights, (None, height, width))[0]
    require("offsets", offsets, (taps, 2, height, width))
    if round(taps**0.5) ** 2 != taps or taps % 2 == 0:
        raise ValueError(f"weights: expected the square of an odd number of maps, got {taps}")
    nothing = np.zeros_like(depth)
    if kept is not None:
        require("kept", kept, (height, width))
        depth = np.where(kept > 0, kept, depth)
    current, following = _bordered(depth), np.zeros((height + 3, width + 3), np.float32)
    for left in reversed(range(iterations)):
        replaced = nothing if kept is None or left == 0 else kept
        threads.run(_propagate_rows, height, current, replaced, offsets, weights, following)
        current, following = following, current
    return np.ascontiguousarray(current[1:-2, 1:-2])


def confidence_times(affinities: Float, confidence: Float, offsets: Float, threads: RowThreads) -> Float:
    """Affinities (n, H, W) times the confidence (H, W) at p + offset (n, 2, H, W). ValueError as `propagated`."""
    height, width = require("confidence", confidence, (None, None))
    taps = require("affinities", affinities, (None, height, width))[0]
    require("offsets", offsets, (taps, 2, height, width))
    out = np.empty_like(affinities)
    threads.run(_confidence_rows, height, _bordered(confidence), offsets, affinities, out)
    return out


def _array(maps: Tensor) -> Float:
    """The only image of a batch as its kernels take it."""
    array: Float = maps[0].contiguous().numpy()
    return array


def kernel_operations(threads: RowThreads) -> Operations:
    """Both operations for batches of one on the CPU, without gradients; of the steps the last one alone."""

    def times_confidence(affinities: Tensor, confidence: Tensor, offsets: Tensor) -> Tensor:
        found = confidence_times(_array(affinities), _array(confidence)[0], _array(offsets), threads)
        return torch.from_numpy(found)[None]

    def propagate(
        depth: Tensor, offsets: Tensor, weights: Tensor, iterations: int, kept: Tensor | None
    ) -> tuple[Tensor, ...]:
        measured = None if kept is None else _array(kept)[0]
        found = propagated(_array(depth)[0], _array(offsets), _array(weights), iterations, measured, threads)
        return (torch.from_numpy(found)[None, None],)

    return Operations(times_confidence, propagate)


def nlspn_forward(model: NLSPN) -> Forward:
    """(1, 1, H, W) and (1, 3, H, W) as the network takes them -> its depth; convolutions by torch, the rest by kernels,
    with as many threads as torch has at the time of this call."""
    operations = kernel_operations(RowThreads(torch.get_num_threads()))
    return lambda sparse, rgb: model.outputs(sparse, rgb, operations).depth
