"""Who computes a network's maps: one call, `run`, whatever stands behind it.

`backends.choose_executor` chooses one when a completer is loaded; nothing after that asks which it is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from completion.decoding import decode_output, require_decoding
from completion.inputs import scale_rgb
from completion.models import ModelSpec
from completion.types import FloatMap

# (1, 1, H, W) and (1, 3, H, W), padded and scaled as the network takes them -> its finest output (1, C, H, W).
Forward = Callable[[Tensor, Tensor], Tensor]


class FrameMaps(NamedTuple):
    """Maps of one frame, (h, w) float32: metres, and the weight of the foreground. One surface: depth alone."""

    depth: FloatMap
    foreground: FloatMap | None = None
    background: FloatMap | None = None
    sigma: FloatMap | None = None


class Executor(Protocol):
    """Computes the maps of a frame; its network, decoding, device and threads are settled when it is made."""

    def run(self, sparse: FloatMap, rgb: NDArray[np.uint8]) -> FrameMaps:
        """Sparse (h, w) float32 metres, 0 = none, and RGB (h, w, 3) of any size -> maps of the same size."""
        ...


class NetworkExecutor:
    """Pads at the top and right, scales, lets `forward` compute the network, cuts back and decodes.

    forward   the network itself (`finest_of`), or what computes the same in its place
    decoding  see `completion.decoding`; ValueError for one that the network does not offer
    """

    def __init__(self, forward: Forward, spec: ModelSpec, decoding: str, device: str | torch.device = "cpu") -> None:
        require_decoding(spec, decoding)
        self.forward, self.spec, self.decoding, self.device = forward, spec, decoding, torch.device(device)

    def run(self, sparse: FloatMap, rgb: NDArray[np.uint8]) -> FrameMaps:
        """See `Executor`."""
        depths = torch.tensor(sparse, device=self.device)[None, None]
        colours = torch.tensor(rgb, device=self.device)[None].permute(0, 3, 1, 2)
        with torch.inference_mode():
            decoded = decode_output(self.output(depths, colours), self.spec, self.decoding)
            depth, *surfaces = (None if part is None else part[0].cpu().numpy() for part in decoded)
        assert depth is not None
        return FrameMaps(depth, *surfaces)

    def output(self, sparse: Tensor, rgb: Tensor) -> Tensor:
        """(1, 1, h, w) metres, (1, 3, h, w) uint8 -> the network's finest output (1, C, h, w), of any size."""
        height, width = sparse.shape[-2:]
        multiple = self.spec.multiple_of
        padding = (0, -width % multiple, -height % multiple, 0)
        colours = F.pad(scale_rgb(rgb, self.spec.rgb), padding, mode="replicate")
        scaled = F.pad(sparse, padding) / self.spec.depth_unit
        full = self.forward(scaled, colours.contiguous(memory_format=torch.channels_last))
        return full[:, :, padding[2] :, :width]


def finest_of(model: nn.Module) -> Forward:
    """A network as a `Forward`: its finest output alone."""

    def forward(sparse: Tensor, rgb: Tensor) -> Tensor:
        outputs = model(sparse, rgb)
        finest: Tensor = outputs[0] if isinstance(outputs, tuple) else outputs
        return finest

    return forward
