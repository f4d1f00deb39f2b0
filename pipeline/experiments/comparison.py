"""Pixel by pixel: TWISE against MultiStack (Eq. 4.9, 4.10; Fig. 4.7, 4.8), and semi-dense ground truth (Table 4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.experiments import frames as stored
from pipeline.experiments.chapter_2_3 import training
from pipeline.experiments.completion_inputs import default_decoding, load_weights, model_spec, test_frame
from pipeline.experiments.runs import Context, Outcome, do_run, plan_run
from pipeline.experiments.tables import Recipe

LEVELS = (0.0, 0.01, 0.1, 1.0)
Depth = NDArray[np.float32]


def predictions(recipe: Recipe, context: Context, paths: Sequence[Path]) -> list[Depth]:
    """Depth of every test frame by the recipe's network, trained first when that has not been done."""
    from completion.infer import network_completer

    run = plan_run(recipe, context.budget, context.data, context.seed)
    do_run(run, context.out, context.data, context.say)
    spec = model_spec(recipe, context.budget)
    model = load_weights(spec, run.folder(context.out) / "last.safetensors")
    completer = network_completer(model, spec, decoding=default_decoding(spec))
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
    stored.write_npz(context.folder / "maps.npz", arrays)
    means = {name: float(np.nanmean(values)) for name, values in frames.items()}
    return Outcome(means | _histogram_numbers(absolute_maps), frames)


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


FOCAL_BASELINE = 721.5377 * 0.532725  # pixels x metres of KITTI's cameras: depth 10 m is 38.4 px of disparity


def audit(context: Context) -> Outcome:
    """The error of pseudo ground truth against the exact depth (Table 4.3), over the test frames that have any.

    disparity_mae_px, disparity_rmse_px   at KITTI's focal length and baseline; outliers_percent: more than 3 px and 5 %
    gt_mae_mm, gt_rmse_mm                 of depth
    density_percent                       pixels with a value, of the pixels a LiDAR measures
    edge_error_percent, edge_pixels_percent   share of the summed error, and of the pixels, at depth edges
    """
    _, paths = stored.ensure_frames(context.out, context.data, context.budget, context.say, ("test",))
    frames: dict[str, list[float]] = {}
    for path in paths:
        frame = stored.load(path)
        if frame.semi_dense is not None and (frame.semi_dense > 0).any():
            for name, value in audit_frame(frame.semi_dense, frame.clean).items():
                frames.setdefault(name, []).append(value)
    return Outcome({name: float(np.mean(values)) for name, values in frames.items()}, frames)


def audit_frame(semi_dense: Depth, clean: Depth) -> dict[str, float]:
    """`audit` of one frame."""
    from completion.diagnostics import edge_mask

    valid = (semi_dense > 0) & (clean > 0)
    noisy, exact = semi_dense[valid].astype(np.float64), clean[valid].astype(np.float64)
    error = np.abs(noisy - exact)
    disparity, shift = FOCAL_BASELINE / exact, np.abs(FOCAL_BASELINE / noisy - FOCAL_BASELINE / exact)
    edges = edge_mask(clean)[valid]
    return {
        "disparity_mae_px": float(shift.mean()),
        "disparity_rmse_px": float(np.sqrt((shift**2).mean())),
        "outliers_percent": 100 * float(((shift > 3) & (shift > 0.05 * disparity)).mean()),
        "gt_mae_mm": 1000 * float(error.mean()),
        "gt_rmse_mm": 1000 * float(np.sqrt((error**2).mean())),
        "density_percent": 100 * float(valid.sum() / max(1, int((clean > 0).sum()))),
        "edge_error_percent": 100 * float(error[edges].sum() / max(1e-9, error.sum())),
        "edge_pixels_percent": 100 * float(edges.mean()),
    }
