"""TWISE and MultiStack for inference on the CPU: the values of `hourglass`, computed by the kernels of `winograd`.

The forward pass of the networks stays as it is; their encoders and decoders are replaced by some that hand on arrays
(H, W, C). ReLUs, sums of features and upsampled features are taken where a convolution reads or writes its maps, and
the maps are kept for the next frame, since a fresh one costs as much as filling it.
"""

from __future__ import annotations

import copy
import threading
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from completion.cpu import convolutions, strided, winograd
from completion.cpu.patches import COARSER, NOTHING, Added, Layer, Summands, bias_of
from completion.cpu.row_threads import RowThreads
from completion.executors import Forward
from completion.models.blocks import DepthDecoder, DepthEncoder, RgbEncoder
from completion.models.hourglass import Hourglasses

Float = NDArray[np.float32]
Features = tuple[Float, ...]


class _Pair:
    """Two convolutions in a row, which is what every step of the networks consists of (see `blocks`)."""

    def __init__(self, block: nn.Sequential, kernels: RowThreads, name: str) -> None:
        first, second = (layer for layer in block if not isinstance(layer, nn.ReLU))
        self.kernels, self.name, self.channels = kernels, name, int(first.out_channels)  # type: ignore[arg-type]
        self.first, self.second = (Layer(_prepared(layer), bias_of(layer)) for layer in (first, second))

    def stem(self, planes: Float, coarse: Float | None) -> Float:
        """Planes (K, H, W) -> (H, W, C), plus a coarser map upsampled."""
        out = self.kernels.map(self.name, *planes.shape[1:], self.channels)
        convolutions.convolve_stem(self.kernels, planes, self.first, self.second, _above(coarse, out), out)
        return out

    def halving(self, x: Float, coarse: Float | None = None) -> Float:
        """(H, W, C) -> (H/2, W/2, C), plus a coarser map upsampled."""
        hidden = self._hidden(x.shape[0] // 2, x.shape[1] // 2)
        convolutions.halve(self.kernels, x, self.first, hidden)
        return self._second((hidden,), self.name, coarse)

    def doubling(self, summands: Features) -> Float:
        """Maps (H, W, C) to be added -> (2H, 2W, C)."""
        height, width, _ = summands[0].shape
        hidden = self._hidden(2 * height, 2 * width)
        convolutions.double(self.kernels, Summands.of(summands), self.first, hidden)
        return self._second((hidden,), self.name)

    def head(self, summands: Features) -> Float:
        """Maps (H, W, C) to be added -> planes (K, H, W)."""
        height, width, _ = summands[0].shape
        hidden = self._hidden(height, width)
        convolutions.convolve(self.kernels, Summands.of(summands), self.first, Added(hidden, NOTHING), hidden)
        out = np.empty((len(self.second.bias), height, width), np.float32)
        convolutions.convolve_head(self.kernels, hidden, self.second, out)
        return out

    def _second(self, summands: Features, name: str, coarse: Float | None = None) -> Float:
        out = self.kernels.map(name, *summands[0].shape[:2], self.channels)
        convolutions.convolve(self.kernels, Summands.of(summands), self.second, _above(coarse, out), out)
        return out

    def _hidden(self, height: int, width: int) -> Float:
        """Between the two convolutions; all pairs share the largest."""
        size = height * width * self.channels
        flat = self.kernels.kept.get("hidden")
        if flat is None or flat.size < size:
            flat = self.kernels.map("hidden", size)
        return flat[:size].reshape(height, width, self.channels)


def _above(coarse: Float | None, out: Float) -> Added:
    """A coarser map upsampled, or nothing."""
    return Added(out, NOTHING) if coarse is None else Added(coarse, COARSER)


def _prepared(layer: Any) -> Float:
    """Weights as the kernel of this kind of layer takes them."""
    if isinstance(layer, nn.ConvTranspose2d):
        return strided.tap_weights(layer.weight, transposed=True)
    if layer.stride[0] == 2:
        return strided.tap_weights(layer.weight)
    if layer.in_channels <= 3:
        return winograd.stem_weights(layer.weight)
    return strided.head_weights(layer.weight) if layer.out_channels <= 3 else winograd.winograd_weights(layer.weight)


def _planes(x: Tensor) -> Float:
    planes: Float = x[0].contiguous().numpy()
    return planes


class _RgbEncoder(nn.Module):
    def __init__(self, block: RgbEncoder, kernels: RowThreads) -> None:
        super().__init__()
        self.steps = [_Pair(step, kernels, f"colour {name}") for name, step in block.named_children()]  # type: ignore[arg-type]

    def forward(self, rgb: Tensor) -> Features:
        features = [self.steps[0].stem(_planes(rgb), None)]
        for step in self.steps[1:]:
            features.append(step.halving(features[-1]))
        return tuple(features)


class _DepthEncoder(nn.Module):
    def __init__(self, block: DepthEncoder, kernels: RowThreads, stage: int) -> None:
        super().__init__()
        self.steps = [_Pair(step, kernels, f"{stage} {name}") for name, step in block.named_children()]  # type: ignore[arg-type]

    def forward(self, depth: Tensor, previous: Features = ()) -> Features:
        coarse = (*previous, None, None, None)
        features = [self.steps[0].stem(_planes(depth), coarse[0])]
        for step, above in zip(self.steps[1:], coarse[1:]):
            features.append(step.halving(features[-1], above))
        return tuple(features)


class _DepthDecoder(nn.Module):
    def __init__(self, block: DepthDecoder, kernels: RowThreads, stage: int, extra_skips: bool) -> None:
        super().__init__()
        steps = (block.dec2, block.dec1, block.prdct)
        self.dec2, self.dec1, self.predict = (
            _Pair(step, kernels, f"{stage} {name}") for step, name in zip(steps, ("half", "full", "head"))
        )
        self.extra_skips = extra_skips

    def forward(self, depth: Features, colour: Features) -> tuple[Tensor, Features]:
        (d0, d1, d2), (c0, c1, c2) = depth, colour
        half = self.dec2.doubling((d2, c2))
        full = self.dec1.doubling((d1, c1, half))
        head = torch.from_numpy(self.predict.head((full, d0, c0)))[None]
        return head, (full, half, d2 + c2) if self.extra_skips else (full,)


def hourglass_forward(model: Hourglasses) -> Forward:
    """(B, 1, H, W) and (B, 3, H, W) as the network takes them -> its finest output, with as many threads as torch.

    The weights are those at the time of this call. About 1 KB per pixel and 64 channels is held between frames
    (600 MB for 352x1216).
    """
    kernels = RowThreads(torch.get_num_threads())
    fast = copy.copy(model)
    fast._modules = {}
    fast.rgb_encoder = _RgbEncoder(model.rgb_encoder, kernels)  # type: ignore[assignment]
    for stage in (1, 2, 3):
        encoder, decoder = getattr(model, f"depth_encoder{stage}"), getattr(model, f"depth_decoder{stage}")
        setattr(fast, f"depth_encoder{stage}", _DepthEncoder(encoder, kernels, stage))
        setattr(fast, f"depth_decoder{stage}", _DepthDecoder(decoder, kernels, stage, model.extra_skips))
    one_at_a_time = threading.Lock()  # the maps are shared

    def run(sparse: Tensor, rgb: Tensor) -> Tensor:
        with one_at_a_time, torch.inference_mode():
            return torch.cat([fast(sparse[i : i + 1], rgb[i : i + 1])[0] for i in range(len(sparse))])

    return run
