"""The border of the convolution kernels: every shape and type is checked, then their rows are shared among threads.

ValueError for maps or weights that do not fit each other: the kernels themselves would overwrite other memory.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from completion.cpu import strided, winograd
from completion.cpu.border import require
from completion.cpu.patches import COARSER, SAME, Added, Layer, Summands
from completion.cpu.row_threads import RowThreads
from completion.cpu.small_gemm import LANES

Float = NDArray[np.float32]


def convolve(rows: RowThreads, summands: Summands, layer: Layer, added: Added, out: Float) -> None:
    """3x3 with padding 1: see `winograd.convolve`."""
    height, width, outputs = require("output", out, (None, None, None), contiguous=True)
    inputs = _require_layer("3x3", layer, (36,), outputs)
    _require_summands(summands, height, width, inputs)
    _require_added(added, height, width, outputs)
    rows.run(winograd.convolve, winograd.tile_rows(out), summands, layer, added, out)


def convolve_stem(rows: RowThreads, planes: Float, stem: Layer, layer: Layer, added: Added, out: Float) -> None:
    """Two 3x3 with padding 1, the first from planes: see `winograd.convolve_stem`."""
    height, width, outputs = require("output", out, (None, None, None), contiguous=True)
    between = _require_layer("3x3", layer, (36,), outputs)
    kinds, _, _ = require("planes", planes, (None, height, width))
    if _require_layer("stem", stem, (), between) != 9 * kinds:
        raise ValueError(f"stem: expected weights of 9 x {kinds} inputs, got shape {stem.weights.shape}")
    _require_added(added, height, width, outputs)
    rows.run(winograd.convolve_stem, winograd.tile_rows(out), planes, stem, layer, added, out)


def halve(rows: RowThreads, x: Float, layer: Layer, out: Float) -> None:
    """3x3 with stride 2 and padding 1: see `strided.halve`."""
    height, width, outputs = require("output", out, (None, None, None), contiguous=True)
    inputs = _require_layer("halving", layer, (9,), outputs)
    require("input", x, (2 * height, 2 * width, inputs), contiguous=True)
    rows.run(strided.halve, height, x, layer, out)


def double(rows: RowThreads, summands: Summands, layer: Layer, out: Float) -> None:
    """3x3 transposed with stride 2: see `strided.double`."""
    height, width, _ = summands.x.shape
    outputs = require("output", out, (2 * height, 2 * width, None), contiguous=True)[2]
    _require_summands(summands, height, width, _require_layer("doubling", layer, (9,), outputs))
    rows.run(strided.double, height, summands, layer, out)


def convolve_head(rows: RowThreads, x: Float, layer: Layer, out: Float) -> None:
    """3x3 with padding 1 to few planes: see `strided.convolve_head`."""
    kinds, height, width = require("output", out, (None, None, None), contiguous=True)
    inputs = _require_layer("head", layer, (), 9 * kinds, biases=kinds)
    require("input", x, (height, width, inputs), contiguous=True)
    rows.run(strided.convolve_head, height, x, layer, out)


def quarter(rows: RowThreads, x: Float, layer: Layer, out: Float) -> None:
    """2x2 with stride 2, from x (H, W, I): see `strided.quarter`."""
    height, width, outputs = require("output", out, (None, None, None), contiguous=True)
    both = _require_layer("quartering", layer, (2,), outputs)
    require("input", x, (2 * height, 2 * width, both // 2), contiguous=True)
    rows.run(strided.quarter, height, x.reshape(height, 2, width, both), layer, out)


def lift(rows: RowThreads, x: Float, layer: Layer, skip: Float, out: Float) -> None:
    """1x1, each pixel repeated 2x2, plus a map: see `strided.lift`."""
    height, width, inputs = require("input", x, (None, None, None), contiguous=True)
    outputs = require("output", out, (2 * height, 2 * width, None), contiguous=True)[2]
    require("skip", skip, out.shape, contiguous=True)
    if _require_layer("lifting", layer, (), outputs) != inputs:
        raise ValueError(f"lifting: expected weights of {inputs} inputs, got shape {layer.weights.shape}")
    rows.run(strided.lift, height, x, layer, skip, out)


def _require_layer(name: str, layer: Layer, leading: tuple[int, ...], outputs: int, biases: int | None = None) -> int:
    """How many inputs the weights (*leading, I, O') have, where O' is `outputs` up to whole lanes."""
    columns = outputs + -outputs % LANES
    shape = require(f"{name} weights", layer.weights, (*leading, None, columns), contiguous=True)
    require(f"{name} bias", layer.bias, (outputs if biases is None else biases,))
    return shape[-2]


def _require_summands(summands: Summands, height: int, width: int, inputs: int) -> None:
    for x in summands[:3]:
        require("input", x, (height, width, inputs), contiguous=True)
    if not 1 <= summands.terms <= 3:
        raise ValueError(f"summands: expected one to three maps, got {summands.terms}")


def _require_added(added: Added, height: int, width: int, outputs: int) -> None:
    """Also for NOTHING, whose map is never read: any map has a type that the kernel is compiled for."""
    if added.kind == SAME:
        require("added map", added.map, (height, width, outputs), contiguous=True)
    else:
        require("added map", added.map, (None, None, outputs if added.kind == COARSER else None), contiguous=True)
