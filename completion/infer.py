"""From one sparse map and one image to a completed depth: any image size, with or without weights.

completer = load_completer("classical")
completed = completer.complete(sparse, image)
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from completion.backends import BACKENDS, choose_executor, torch_executor
from completion.checkpoints import load_checkpoint
from completion.executors import Executor
from completion.models import ModelSpec
from completion.models.classical import ClassicalCompleter
from completion.types import CompletedDepth, DepthFrame, FloatMap
from completion.windows import ARCHITECTURES as WINDOWED
from completion.windows import WindowCompleter


class Completer(Protocol):
    """Anything that completes depth."""

    def complete(
        self, sparse: FloatMap, image: NDArray[np.uint8], K: NDArray[np.float64] | None = None
    ) -> CompletedDepth:
        """Sparse (H, W) float32 metres (0 = none) and RGB (H, W, 3) uint8 -> dense maps of the same size."""
        ...


class NetworkCompleter:
    """Checks a frame, lets an executor compute its maps, checks those.

    rows  predict the bottom `rows` rows only (published protocols: 352, 256), 0 elsewhere; None: full height
    """

    def __init__(self, executor: Executor, rows: int | None = None) -> None:
        self.executor, self.rows = executor, rows

    def complete(
        self, sparse: FloatMap, image: NDArray[np.uint8], K: NDArray[np.float64] | None = None
    ) -> CompletedDepth:
        """One frame; see `Completer`. ValueError for maps that are no DepthFrame."""
        frame = DepthFrame(image, sparse, None, K)
        top = 0 if self.rows is None else max(0, frame.size[0] - self.rows)
        maps = self.executor.run(frame.sparse[top:], frame.image[top:])
        depth, *surfaces = (None if part is None else np.pad(part, ((top, 0), (0, 0))) for part in maps)
        assert depth is not None
        return CompletedDepth(depth, *surfaces)


def network_completer(
    model: nn.Module,
    spec: ModelSpec,
    device: str | torch.device = "cpu",
    decoding: str = "fused",
    rows: int | None = None,
) -> Completer:
    """The completer of a network, computed by torch on one device; the network is moved there and set to `eval`.

    decoding  see `completion.decoding`; ValueError for one that the network does not offer
    rows      see `NetworkCompleter`; ENet and PENet see the window of `completion.windows` in any case
    """
    if spec.architecture in WINDOWED:
        return WindowCompleter(model, spec, device, decoding)
    return NetworkCompleter(torch_executor(model, spec, device, decoding), rows)


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
    if card.model.architecture in WINDOWED:
        if backend not in ("torch", "auto"):
            raise ValueError(f"backend {backend!r} does not run {card.model.architecture}; use backend 'torch'")
        return network_completer(model, card.model, device, card.decoding)
    return NetworkCompleter(choose_executor(model, card, device, backend))
