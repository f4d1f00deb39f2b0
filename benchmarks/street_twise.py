"""A TWISE whose outputs are depths of streets, within seconds: random features, heads fitted by least squares.

No weights of TWISE-64 are shipped and training takes hours. Differences between backends mean something only
on outputs in metres, so the last layer of each stage, which is linear, is solved for the true depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from completion.models import ModelSpec, build_model
from completion.types import DepthFrame

SAMPLES = 4000  # pixels per frame and stage
RIDGE = 1e-3  # of the mean square of a feature


def cropped(frame: DepthFrame, rows: int, columns: int, left: int = 0) -> DepthFrame:
    """The bottom `rows` rows, and `columns` columns from `left`."""
    part = np.s_[-rows:, left : left + columns]
    assert frame.target is not None
    contiguous = np.ascontiguousarray
    return DepthFrame(contiguous(frame.image[part]), contiguous(frame.sparse[part]), contiguous(frame.target[part]))


def given(frame: DepthFrame) -> tuple[Tensor, Tensor]:
    """(1, 1, H, W) in units of 80 m and (1, 3, H, W) in 0..1, as TWISE takes them."""
    rgb = torch.from_numpy(frame.image).permute(2, 0, 1)[None] / 255
    return torch.from_numpy(frame.sparse)[None, None] / 80, rgb


def street_twise(spec: ModelSpec, frames: Sequence[DepthFrame]) -> nn.Module:
    """TWISE with the heads of its stages, coarse to fine, fitted to frames whose sizes are multiples of 16."""
    torch.manual_seed(0)
    model = build_model(ModelSpec(spec.architecture, {**spec.arguments, "init": "he"}, spec.depth_unit)).eval()
    for stage, factor in ((1, 4), (2, 2), (3, 1)):
        _fit(model, getattr(model, f"depth_decoder{stage}").prdct[-1], 3 - stage, factor, frames)
    return model


def _fit(model: nn.Module, head: Any, output: int, factor: int, frames: Sequence[DepthFrame]) -> None:
    """Solves a head for what is missing to the true depth in the model's output of this number."""
    nn.init.zeros_(head.weight)
    nn.init.zeros_(head.bias)
    seen: list[Tensor] = []
    hook = head.register_forward_hook(lambda _layer, inputs, _output: seen.append(inputs[0]))
    features, missing = [], []
    generator = torch.Generator().manual_seed(0)
    for frame in frames:
        with torch.inference_mode():
            found = model(*given(frame))[output][0, 0]
        assert frame.target is not None
        truth = torch.from_numpy(frame.target)[::factor, ::factor] / 80
        pixels = torch.nonzero(((truth > 0) & (truth <= 1)).flatten()).flatten()
        chosen = pixels[torch.randperm(len(pixels), generator=generator)[:SAMPLES]]
        features.append(F.unfold(seen.pop(), 3, padding=1)[0].T[chosen])
        missing.append((truth - found).flatten()[chosen])
    hook.remove()
    x = torch.cat(features).double()
    x = torch.cat((x, torch.ones_like(x[:, :1])), 1)
    moment = x.T @ x
    moment.diagonal().add_(RIDGE * float(moment.diagonal().mean()))
    solution = torch.linalg.solve(moment, x.T @ torch.cat(missing).double()).float()
    with torch.no_grad():  # both surfaces; the logit of sigma stays 0
        head.weight[:2] = solution[:-1].view(head.weight.shape[1:])
        head.bias[:2] = solution[-1]
