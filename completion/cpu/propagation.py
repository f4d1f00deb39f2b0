"""The deformable operations of NLSPN (`completion.models.deformable`) for inference on the CPU: the same, faster.

All iterations read the same pixels with the same factors. They are laid out once in the order in which an iteration
reads them: all neighbours of a pixel in a row, so that its sum stays in registers.
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
def _place(position, limit):  # type: ignore[no-untyped-def]
    """Row or column in a bordered map of the first of two pixels round a position, and the share of the second."""
    # Farther out both pixels lie in the border, where all is 0.
    if position < -_ONE:
        position = -_ONE
    if position > limit:
        position = limit
    low = np.floor(position)
    # A NaN must not become an index; it reaches the output through its share.
    return (np.int32(low) + np.int32(1) if low >= -_ONE else np.int32(0)), position - low


@njit(cache=True, nogil=True, error_model="numpy")
def _plan_rows(first, last, offsets, weights, corners, factors):  # type: ignore[no-untyped-def]
    """Rows first..last of corners (H, W, n) and factors (H, 4, W, n) of the n = K^2 - 1 neighbours without the centre.

    corners  upper left of the four in a bordered flat map; factors  bilinear shares times the weights (K^2, H, W)
    """
    taps, height, width = weights.shape
    kernel, bottom, right = int(np.sqrt(np.float64(taps)) + 0.5), np.float32(height), np.float32(width)
    for y in range(first, last):
        for neighbour in range(taps - 1):
            tap = neighbour + (1 if neighbour >= taps // 2 else 0)
            row, column = np.float32(y + tap // kernel - kernel // 2), np.float32(tap % kernel - kernel // 2)
            for x in range(width):
                top, down = _place(row + offsets[tap, 0, y, x], bottom)
                left, beside = _place(column + np.float32(x) + offsets[tap, 1, y, x], right)
                lower = weights[tap, y, x] * down
                upper = weights[tap, y, x] - lower
                corners[y, x, neighbour] = top * (width + 3) + left
                factors[y, 0, x, neighbour] = upper * (_ONE - beside)
                factors[y, 1, x, neighbour] = upper * beside
                factors[y, 2, x, neighbour] = lower * (_ONE - beside)
                factors[y, 3, x, neighbour] = lower * beside


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _propagate_rows(first, last, values, centre, corners, factors, kept, out):  # type: ignore[no-untyped-def]
    """Rows first..last of one iteration: bordered values (H + 3, W + 3) -> the inside of out.

    centre  (H, W) weight of the pixel itself; corners, factors  see `_plan_rows`
    kept    (H, W); where it is > 0, out gets it in place of the iteration's value (for the next iteration)
    """
    _, width, neighbours = corners.shape
    flat, stride, one = values.ravel(), np.uint32(values.shape[1]), np.uint32(1)
    for y in range(first, last):
        for x in range(width):
            total = centre[y, x] * values[y + 1, x + 1]
            for n in range(neighbours):
                upper = np.uint32(corners[y, x, n])
                lower = np.uint32(upper + stride)
                total += (
                    factors[y, 0, x, n] * flat[upper]
                    + factors[y, 1, x, n] * flat[np.uint32(upper + one)]
                    + factors[y, 2, x, n] * flat[lower]
                    + factors[y, 3, x, n] * flat[np.uint32(lower + one)]
                )
            out[y + 1, x + 1] = kept[y, x] if kept[y, x] > _ZERO else total


@njit(cache=True, nogil=True, error_model="numpy")
def _confidence_rows(first, last, values, offsets, affinities, out):  # type: ignore[no-untyped-def]
    """Rows first..last of out (n, H, W) = affinities times bordered values at p + offset."""
    taps, height, width = affinities.shape
    bottom, right = np.float32(height), np.float32(width)
    for y in range(first, last):
        for tap in range(taps):
            for x in range(width):
                top, down = _place(np.float32(y) + offsets[tap, 0, y, x], bottom)
                left, beside = _place(np.float32(x) + offsets[tap, 1, y, x], right)
                upper = values[top, left] * (_ONE - beside) + values[top, left + 1] * beside
                lower = values[top + 1, left] * (_ONE - beside) + values[top + 1, left + 1] * beside
                out[tap, y, x] = affinities[tap, y, x] * (upper * (_ONE - down) + lower * down)


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
    corners, factors = np.empty((height, width, taps - 1), np.int32), np.empty((height, 4, width, taps - 1), np.float32)
    threads.run(_plan_rows, height, offsets, weights, corners, factors)
    current, following = _bordered(depth), np.zeros((height + 3, width + 3), np.float32)
    for left in reversed(range(iterations)):
        replaced = nothing if kept is None or left == 0 else kept
        threads.run(_propagate_rows, height, current, weights[taps // 2], corners, factors, replaced, following)
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
