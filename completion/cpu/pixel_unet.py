"""`selection.PixelUNet` for inference on the CPU, by the kernels of `winograd`."""

from __future__ import annotations

import threading
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from completion.cpu import convolutions, strided, winograd
from completion.cpu.patches import LINEAR, NOTHING, RECTIFIED, SAME, Added, Layer, Summands, bias_of
from completion.cpu.row_threads import RowThreads
from completion.cpu.small_gemm import multiply, with_whole_lanes
from completion.models.selection import PixelUNet, Residual

Float = NDArray[np.float32]


class Head(NamedTuple):
    """The last layer: weights (2, C, 2 outputs) and bias (2, 2 outputs) for even and odd rows of the image; columns for
    even and odd pixels side by side, zeros up to whole lanes."""

    weights: Float
    bias: Float


class PixelUNetKernels:
    """The convolutions of a U-Net with its weights at the time of this call, and as many threads as torch has then.

    outputs  how many of the network's outputs are read (None: all): the first ones
    lock     to be held while the result of `before_head` is in use: its memory is kept from frame to frame
    """

    def __init__(self, network: PixelUNet, outputs: int | None = None) -> None:
        self.network = network
        self.rows = RowThreads(torch.get_num_threads())
        self.lock = threading.Lock()
        self.stem = _winograd(network.stem)
        self.encoder = [[_residual(one) for one in stage.children()] for stage in network.encoder]
        self.down = [Layer(strided.quarter_weights(one.weight), bias_of(one)) for one in network.down]  # type: ignore[arg-type]
        self.up = [Layer(with_whole_lanes(_array(one.weight[:, :, 0, 0].T)), bias_of(one)) for one in network.up]  # type: ignore[index]
        self.decoder = [_residual(one) for one in network.decoder]
        read = network.head.weight[:, :, 0, 0], _tensor(network.head.bias)
        self.head = Head(_head(read[0], outputs), _head(read[1], outputs))

    def __call__(self, features: Tensor) -> Tensor:
        """(1, 4 inputs, H/2, W/2) -> (1, 4 outputs, H/2, W/2), like `PixelUNet.at_half`."""
        with self.lock, torch.inference_mode():
            hidden = self.before_head(_array(features[0].permute(1, 2, 0)))
            head: Tensor = self.network.head(F.relu(torch.from_numpy(hidden).permute(2, 0, 1)[None]))
        return head

    def before_head(self, features: Float) -> Float:
        """(H/2, W/2, 4 inputs) -> (H/2, W/2, C), what the head rectifies; overwritten by the next call."""
        x = self._convolve("stem", features, LINEAR, self.stem)
        skips = []
        for level, (stage, down) in enumerate(zip(self.encoder, self.down)):
            x = self._residuals(f"encoder {level}", x, stage)
            skips.append(x)
            x = self._quarter(f"down {level}", x, down)
        x = self._residuals("bottom", x, self.encoder[-1])
        for level in reversed(range(len(skips))):
            x = self._lift(f"up {level}", x, self.up[level], skips[level])
            x = self._residuals(f"decoder {level}", x, [self.decoder[level]])
        return x

    def _residuals(self, name: str, x: Float, layers: list[tuple[Layer, Layer]]) -> Float:
        for number, (first, second) in enumerate(layers):
            hidden = self._convolve(f"{name} hidden", x, RECTIFIED, first)
            x = self._convolve(f"{name} {number}", hidden, RECTIFIED, second, x)
        return x

    def _convolve(self, name: str, x: Float, least: np.float32, layer: Layer, added: Float | None = None) -> Float:
        out = self.rows.map(name, *x.shape[:2], len(layer.bias))
        other = Added(out, NOTHING) if added is None else Added(added, SAME)
        convolutions.convolve(self.rows, Summands.of((x,), least), layer, other, out)
        return out

    def _quarter(self, name: str, x: Float, layer: Layer) -> Float:
        out = self.rows.map(name, x.shape[0] // 2, x.shape[1] // 2, len(layer.bias))
        convolutions.quarter(self.rows, x, layer, out)
        return out

    def _lift(self, name: str, x: Float, layer: Layer, skip: Float) -> Float:
        out = self.rows.map(name, *skip.shape)
        convolutions.lift(self.rows, x, layer, skip, out)
        return out


@njit(inline="always")
def head_of(row, first, weights, rectified, out):  # type: ignore[no-untyped-def]
    """The last layer without its bias for len(out) pixels of a row (W/2, C) of `before_head` from `first` on.

    weights (C, O) of `Head`, rectified (n, C) for use inside, out (n, O)
    """
    for i in range(len(out)):
        for c in range(row.shape[1]):
            rectified[i, c] = max(row[first + i, c], np.float32(0))
    multiply(rectified, weights, out)


def _tensor(bias: Tensor | None) -> Tensor:
    assert bias is not None
    return bias


def _array(x: Tensor) -> Float:
    return np.asarray(x.detach().contiguous().numpy())


def _winograd(layer: nn.Conv2d) -> Layer:
    return Layer(winograd.winograd_weights(layer.weight), bias_of(layer))


def _residual(block: nn.Module) -> tuple[Layer, Layer]:
    assert isinstance(block, Residual)
    return _winograd(block.conv1), _winograd(block.conv2)


def _head(parameters: Tensor, outputs: int | None) -> Float:
    """Rows (4 outputs, ...) of the last layer -> (2, ..., 2 outputs): row of the image; output and column of the image.

    Undoes the pixel shuffle.
    """
    shuffled = parameters.detach().unflatten(0, (-1, 2, 2))[:outputs]
    rest = tuple(range(3, shuffled.ndim))
    return with_whole_lanes(_array(shuffled.permute(1, *rest, 0, 2).flatten(-2)))
