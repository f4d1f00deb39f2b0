"""TWISE against MultiStack pixel by pixel (Eq. 4.9, 4.10; Fig. 4.7, 4.8): two finished runs on the same test frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.experiments import frames as stored
from pipeline.experiments.chapter_2_3 import training
from pipeline.experiments.completion_runs import default_read_out, load_weights, model_spec, test_frame
from pipeline.experiments.runs import Context, Outcome, do_run, plan_run
from pipeline.experiments.tables import Recipe
from pipeline.runner.atomic import write_bytes

LEVELS = (0.0, 0.01, 0.1, 1.0)
Depth = NDArray[np.float32]


def predictions(recipe: Recipe, context: Context, paths: Sequence[Path]) -> list[Depth]:
    """Depth of every test frame by the recipe's network, trained first when that has not been done."""
    from completion.infer import NetworkCompleter

    run = plan_run(recipe, context.budget, context.data, context.seed)
    do_run(run, context.out, context.data, context.say)
    spec = model_spec(recipe, context.budget)
    model = load_weights(spec, run.folder(context.out) / "last.safetensors")
    completer = NetworkCompleter(model, spec, read_out=default_read_out(spec))
    frames = [test_frame(recipe, path) for path in paths]
    return [completer.complete(frame.sparse[64], frame.image).depth for frame in frames]


def compare(recipe: Recipe, context: Context) -> Outcome:
    """Share of pixels at which the second network is better and worse than the first by more than each level.

    Names: "LEVEL/better_percent", "LEVEL/worse_percent", "LEVEL/better_edge_percent", "LEVEL/worse_edge_percent".
    The absolute maps of all frames go to maps.npz in the run's folder, for the figures.
    """
    from completion.analysis import relative_error_maps
    from completion.diagnostics import edge_mask

    _, paths = stored.ensure_frames(context.out, context.data, context.budget, context.say)
    first, second = (training(*name.split()) for name in recipe.settings["compare"])
    both = zip(predictions(first, context, paths), predictions(second, context, paths), paths)
    frames: dict[str, list[float]] = {}
    absolute_maps, squared_maps = [], []
    for baseline, ours, path in both:
        target = stored.load(path).clean
        absolute, squared = relative_error_maps(baseline, ours, target)
        absolute_maps.append(absolute)
        squared_maps.append(squared)
        for name, value in _shares(absolute, edge_mask(target)).items():
            frames.setdefault(name, []).append(value)
    arrays: dict[str, Any] = {"absolute": np.stack(absolute_maps[:8]), "squared": np.stack(squared_maps[:8])}
    write_bytes(context.folder / "maps.npz", _npz(arrays))
    means = {name: float(np.nanmean(values)) for name, values in frames.items()}
    return Outcome(means | _histogram_numbers(absolute_maps), frames)


def _npz(arrays: dict[str, Any]) -> bytes:
    import io

    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def _shares(absolute: Depth, edges: NDArray[np.bool_]) -> dict[str, float]:
    """Percent of the valid pixels, of all and of those at depth edges."""
    found: dict[str, float] = {}
    for region, name in ((np.isfinite(absolute), ""), (np.isfinite(absolute) & edges, "edge_")):
        values = absolute[region]
        for level in LEVELS:
            count = max(1, len(values))
            found[f"{level:g}/better_{name}percent"] = 100 * float((values > level).sum()) / count
            found[f"{level:g}/worse_{name}percent"] = 100 * float((values < -level).sum()) / count
    return found


def _histogram_numbers(maps: Sequence[Depth]) -> dict[str, float]:
    """Mean gain where better, mean loss where worse, in mm: few large losses against many small gains?"""
    values = np.concatenate([m[np.isfinite(m)] for m in maps])
    better, worse = values[values > 0], -values[values < 0]
    return {
        "mean_gain_mm": 1000 * float(better.mean()) if len(better) else 0.0,
        "mean_loss_mm": 1000 * float(worse.mean()) if len(worse) else 0.0,
    }
