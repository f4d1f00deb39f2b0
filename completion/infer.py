"""From one sparse map and one image to a completed depth: any image size, with or without weights.

completer = load_completer("classical")
completed = completer.complete(sparse, image)
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from completion.backends import BACKENDS, Convolutions, other_than_torch
from completion.checkpoints import load_checkpoint
from completion.cpu.pixel_unet import PixelUNetKernels
from completion.cpu.ring_coefficients import complete_coefficients
from completion.cpu.selection import complete_mixture
from completion.decoding import Maps, decode_output, require_decoding
from completion.inputs import scale_rgb
from completion.models import ModelSpec
from completion.models.classical import ClassicalCompleter
from completion.models.selection import Selection
from completion.types import CompletedDepth, DepthFrame, FloatMap


class Completer(Protocol):
    """Anything that completes depth."""

    def complete(
        self, sparse: FloatMap, image: NDArray[np.uint8], K: NDArray[np.float64] | None = None
    ) -> CompletedDepth:
        """Sparse (H, W) float32 metres (0 = none) and RGB (H, W, 3) uint8 -> dense maps of the same size."""
        ...


class NetworkCompleter:
    """A network with its input scaling, on one device. Any image size: padded at the top and right, cut back after.

    decoding      see `completion.decoding`
    rows          predict the bottom `rows` rows only (published protocols: 352, 256), 0 elsewhere; None: full height
    convolutions  computes the network's convolutions in its place (see `completion.backends`); None: torch does
    """

    def __init__(
        self,
        model: nn.Module,
        spec: ModelSpec,
        device: str | torch.device = "cpu",
        decoding: str = "fused",
        rows: int | None = None,
        convolutions: Convolutions | None = None,
    ) -> None:
        require_decoding(spec, decoding)
        self.device = torch.device(device)
        self.model = model.to(device=self.device, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
        self.spec, self.decoding, self.rows, self.convolutions = spec, decoding, rows, convolutions

    def complete(
        self, sparse: FloatMap, image: NDArray[np.uint8], K: NDArray[np.float64] | None = None
    ) -> CompletedDepth:
        """One frame; see `Completer`. ValueError for maps that are no DepthFrame."""
        return self.complete_batch([DepthFrame(image, sparse, None, K)])[0]

    def complete_batch(self, frames: Sequence[DepthFrame]) -> list[CompletedDepth]:
        """Several frames of one size in one pass. ValueError when sizes differ."""
        if not frames:
            return []
        sizes = {frame.size for frame in frames}
        if len(sizes) != 1:
            raise ValueError(f"a batch must have one image size, got {sorted(sizes)}")
        height = frames[0].size[0]
        top = 0 if self.rows is None else max(0, height - self.rows)
        sparse = torch.from_numpy(np.stack([frame.sparse[top:] for frame in frames]))[:, None]
        rgb = torch.from_numpy(np.stack([frame.image[top:] for frame in frames])).permute(0, 3, 1, 2)
        with torch.inference_mode():
            completed = self._run(sparse.to(self.device), rgb.to(self.device))
        depth, foreground, background, sigma = (
            None if part is None else F.pad(part, (0, 0, top, 0)).cpu().numpy() for part in completed
        )
        assert depth is not None
        if foreground is None or background is None or sigma is None:
            return [CompletedDepth(one) for one in depth]
        return [CompletedDepth(*maps) for maps in zip(depth, foreground, background, sigma)]

    def _run(self, sparse: Tensor, rgb: Tensor) -> Maps:
        """(B, 1, h, w), (B, 3, h, w) uint8 -> depth, foreground, background, sigma, each (B, h, w) or None."""
        if isinstance(self.model, Selection) and self.device.type == "cpu":
            return self._run_selection(self.model, sparse, rgb)
        if isinstance(self.convolutions, PixelUNetKernels):
            return self._run_coefficients(self.convolutions, sparse, rgb), None, None, None
        return decode_output(self._network_output(sparse, rgb), self.spec, self.decoding)

    def _network_output(self, sparse: Tensor, rgb: Tensor) -> Tensor:
        """(B, 1, h, w) metres, (B, 3, h, w) uint8 -> the finest output (B, C, h, w), of any size."""
        height, width = sparse.shape[-2:]
        multiple = self.spec.multiple_of
        padding = (0, -width % multiple, -height % multiple, 0)
        colours = F.pad(scale_rgb(rgb, self.spec.rgb), padding, mode="replicate")
        scaled = F.pad(sparse, padding) / self.spec.depth_unit
        full = self._forward(scaled, colours.contiguous(memory_format=torch.channels_last))
        return full[:, :, padding[2] :, :width]

    def _forward(self, sparse: Tensor, rgb: Tensor) -> Tensor:
        """Inputs as the network takes them -> its finest output."""
        if self.convolutions is not None:
            return self.convolutions(sparse, rgb)
        outputs = self.model(sparse, rgb)
        finest: Tensor = outputs[0] if isinstance(outputs, tuple) else outputs
        return finest

    def _run_selection(self, model: Selection, sparse: Tensor, rgb: Tensor) -> Maps:
        frames = [
            complete_mixture(model, self.convolutions, one[0].numpy(), image.numpy(), self.spec.rgb, self.decoding)
            for one, image in zip(sparse, rgb.permute(0, 2, 3, 1))
        ]
        depth, foreground, background, sigma = (torch.from_numpy(np.stack(maps)) for maps in zip(*frames))
        return depth, foreground, background, sigma

    def _run_coefficients(self, kernels: PixelUNetKernels, sparse: Tensor, rgb: Tensor) -> Tensor:
        frames = [
            complete_coefficients(self.spec.bins, kernels, one[0].numpy(), image.numpy(), self.spec.rgb, self.decoding)
            for one, image in zip(sparse, rgb.permute(0, 2, 3, 1))
        ]
        return torch.from_numpy(np.stack(frames))


def load_completer(path_or_name: str | Path, device: str = "cpu", backend: str = "torch") -> Completer:
    """The completer of a weights file, of a bundled name, or "classical" (no weights, no backend).

    ValueError for an unknown backend or one that cannot run this network there, ImportError without its packages,
    `checkpoints.CheckpointError` for weights that cannot be used.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend: expected one of {', '.join(BACKENDS)}, got {backend!r}")
    if str(path_or_name) == "classical":
        return ClassicalCompleter()
    model, card = load_checkpoint(path_or_name)
    convolutions = other_than_torch(model, card, device, backend)
    return NetworkCompleter(model, card.model, device, card.decoding, convolutions=convolutions)
