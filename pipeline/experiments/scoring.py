"""Scores of a completion network on stored frames: every read-out, region and kind of ground truth in one pass."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.experiments.frames import StoredFrame, write_npz
from pipeline.experiments.runs import Outcome

if TYPE_CHECKING:
    from torch import nn

    from completion.infer import Completer
    from completion.models import ModelSpec
    from completion.types import DepthFrame

Depth = NDArray[np.float32]
EXAMPLES = 2
# Kept per frame too, for intervals of a single seed.
PER_FRAME = ("mae_mm", "rmse_mm", "tmae_mm", "trmse_mm", "mixed_percent", "edge_tmae_mm")


def frame_scores(depth: Depth, target: Depth) -> dict[str, float]:
    """`completion.metrics.depth_metrics` (KITTI's rules) and what happens at depth edges; NaN where there is none."""
    from completion.analysis import mixed_share
    from completion.diagnostics import edge_mask
    from completion.metrics import depth_metrics

    found = depth_metrics(depth, target)
    valid = target > 0
    error = 1000 * np.abs(depth - target)
    edges = edge_mask(target) & valid
    return found | {
        "mixed_percent": 100 * mixed_share(depth, target),
        "edge_tmae_mm": float(np.minimum(error[edges], 1000).mean()) if edges.any() else float("nan"),
        "above_1m_percent": 100 * float((error[valid] > 1000).mean()),
    }


def completers(model: nn.Module, spec: ModelSpec, first: str) -> dict[str, Completer]:
    """One for each decoding of a network, by name; `first` comes first."""
    from completion.decoding import DECODINGS_OF
    from completion.infer import network_completer

    names = dict.fromkeys((first, *DECODINGS_OF[spec.output]))
    return {name: network_completer(model, spec, decoding=name) for name in names}


def decodings(by_decoding: Mapping[str, Completer], frame: DepthFrame) -> dict[str, Depth]:
    """Depth by decoding, in the order of `completers`."""
    from completion.twin_surface import fuse

    (first, completer), *others = by_decoding.items()
    completed = completer.complete(frame.sparse, frame.image)
    found = {first: completed.depth}
    for name, other in others:
        if completed.foreground is not None and completed.background is not None and completed.sigma is not None:
            found[name] = fuse(completed.foreground, completed.background, completed.sigma, name)
        else:
            found[name] = other.complete(frame.sparse, frame.image).depth
    return found


def score(by_decoding: Mapping[str, Completer], frames: Sequence[StoredFrame], diagnosed: int) -> Outcome:
    """Means over test frames of the `completers` of a network.

    Names: "mae_mm" and so on for the default read-out against clean truth; "DECODING/mae_mm"; "semi_dense/mae_mm"
    against pseudo ground truth; "whole/", "edge/", "inside/" by region (Table 4.2); and, over the first `diagnosed`
    frames, what `completion.diagnostics.diagnose` finds: "alive/grey_mae_mm", "alive/sigma_spread", ...
    """
    from completion.analysis import region_metrics
    from completion.diagnostics import diagnose
    from completion.types import DepthFrame

    columns: dict[str, list[float]] = {}

    def add(view: str, scores: dict[str, float], number: int) -> None:
        for name, value in scores.items():
            key = f"{view}/{name}" if view else name
            values = columns.setdefault(key, [])
            values.extend([float("nan")] * (number - len(values)))
            values.append(value)

    for number, frame in enumerate(frames):
        found = decodings(by_decoding, DepthFrame(frame.image, frame.sparse[64]))
        for index, (name, depth) in enumerate(found.items()):
            scores = frame_scores(depth, frame.clean)
            add(name, scores, number)
            if index == 0:
                add("", scores, number)
                if frame.semi_dense is not None and frame.semi_dense.any():
                    add("semi_dense", frame_scores(depth, frame.semi_dense), number)
                if frame.foreground is not None:
                    for region, scores in region_metrics(depth, frame.clean, frame.foreground).items():
                        add(region, scores, number)
    numbers = {name: _mean(values) for name, values in columns.items()}
    some = [DepthFrame(frame.image, frame.sparse[64], frame.clean) for frame in frames[:diagnosed]]
    numbers |= {f"alive/{name}": value for name, value in diagnose(next(iter(by_decoding.values())), some).items()}
    kept = {name: values for name, values in columns.items() if name.rpartition("/")[2] in PER_FRAME}
    return Outcome(numbers, {name: _padded(values, len(frames)) for name, values in kept.items()})


def save_examples(folder: Path, completer: Completer, frames: Sequence[StoredFrame]) -> None:
    """examples.npz: image, depth and truth of the first test frames, for figures."""
    parts: dict[str, NDArray[np.generic]] = {}
    for number, frame in enumerate(frames[:EXAMPLES]):
        parts[f"image_{number}"] = frame.image
        parts[f"depth_{number}"] = completer.complete(frame.sparse[64], frame.image).depth.astype(np.float16)
        parts[f"clean_{number}"] = frame.clean.astype(np.float16)
    write_npz(folder / "examples.npz", parts)


def _mean(values: Sequence[float]) -> float:
    numbers = np.asarray(values, np.float64)
    finite = numbers[np.isfinite(numbers)]
    return float(finite.mean()) if len(finite) else float("nan")


def _padded(values: list[float], count: int) -> list[float]:
    return values + [float("nan")] * (count - len(values))
