"""Runs of kind "cloud": what input clouds of the test frames consist of. Nothing is trained.

Settings of a recipe: `input` and `rows` as for "detection", and `study`:
  "points"  points per frame, kinds of noise, and what furthest point sampling makes of them (Fig. 5.4, 5.5, 5.7)
  "sigma"   what the sigma filter removes at other thresholds (Fig. 5.6)
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import UsageError
from pipeline.base.settings import nearest_name
from pipeline.experiments.cloud_cache import CloudCache, DepthCache
from pipeline.experiments.cloud_study import GAPS, LOWS, SigmaSweep
from pipeline.experiments.detection_budget import DETECTION, DetectionBudget
from pipeline.experiments.detection_runs import DetectionRecipe, clouds_of, data_identity, world_of
from pipeline.experiments.inputs import InputCloud, InputRecipe
from pipeline.experiments.runs import Context, Cost, Outcome
from pipeline.experiments.tables import Recipe
from pipeline.pointcloud.semantic_mask import object_score
from pipeline.pointcloud.taxonomy import NOISE_BG, NOISE_FG, NOISE_INBET, UNKNOWN, Taxonomy, label_noise

BUDGETS: Mapping[str, DetectionBudget] = DETECTION
# Encoder levels of the thesis' backbone (Fig. 5.5).
LEVELS = (4096, 1024, 256, 64)

__all__ = ["BUDGETS", "cost", "data_identity", "run"]


def cost(recipe: Recipe, budget: DetectionBudget) -> Cost:
    """The test clouds, and sampling from them."""
    frames = budget.test_frames
    return Cost(0.4 * frames, 26.0 * budget.cloud_points * frames, budget.seconds_per_data_frame * frames, 5e6 * frames)


def run(recipe: Recipe, context: Context) -> Outcome:
    """Counts over the test frames; values per frame are kept, so that intervals can be made."""
    settings = dict(recipe.settings)
    study = str(settings.pop("study", "points"))
    if study not in STUDIES:
        raise UsageError(f"unknown study of clouds {study!r}; {nearest_name(study, STUDIES)}")
    recipe_of_cloud = DetectionRecipe.of(settings).test_input
    clouds = clouds_of(world_of(context).test, recipe_of_cloud, context)
    return STUDIES[study](clouds, recipe_of_cloud)


def _points(clouds: CloudCache, recipe: InputRecipe) -> Outcome:
    rows: dict[str, list[float]] = {}
    for frame in clouds.dataset:
        cloud = clouds.read(frame.id)
        values = {"points": _output_points(cloud), **shares(cloud, "all")}
        seen = clouds.point_frame(frame)
        for count, picked in zip(LEVELS, picked_by_fps(seen, LEVELS)):
            values |= shares(
                InputCloud(cloud.points[picked], cloud.kind[picked], cloud.objects[picked]), f"fps_{count}"
            )
        for name, value in values.items():
            rows.setdefault(name, []).append(value)
    return Outcome({name: _mean(values) for name, values in rows.items()}, rows)


def _output_points(cloud: InputCloud) -> float:
    """Points of the whole cloud, before it is cut to the detector's area."""
    joined = [after for step, _, after in cloud.counts if step == "join"]
    return float(joined[-1] if joined else len(cloud.points))


def _mean(values: list[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def shares(cloud: InputCloud, view: str) -> dict[str, float]:
    """Percent of the points whose truth is known that are noise (of any kind, or between surfaces), background,
    objects, and objects without noise; NaN where no truth is known."""
    known = cloud.kind != UNKNOWN
    kind, objects = cloud.kind[known], cloud.objects[known]
    noise = np.isin(kind, (NOISE_FG, NOISE_INBET, NOISE_BG))
    parts = {
        "noise": noise,
        "inbet": kind == NOISE_INBET,
        "background": ~objects,
        "useless": noise | ~objects,
        "object": objects & ~noise,
    }
    return {f"{view}/{name}": 100 * float(part.mean()) if len(part) else float("nan") for name, part in parts.items()}


def picked_by_fps(frame: Any, counts: tuple[int, ...]) -> list[NDArray[np.int64]]:
    """Indices into the frame's points that furthest point sampling keeps, level after level, starting at the first."""
    import torch

    from detection.ops import furthest_point_sample

    T = frame.T_cam_velo
    xyz = (frame.points[:, :3].astype(np.float64) @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    index = np.arange(len(xyz))
    levels = []
    for count in counts:
        if len(index):
            chosen = furthest_point_sample(torch.from_numpy(xyz[index]), min(count, len(index)))
            index = index[np.unique(chosen.numpy())]
        levels.append(index)
    return levels


def _sigma(clouds: CloudCache, recipe: InputRecipe) -> Outcome:
    sweep = SigmaSweep()
    depths: DepthCache = clouds.depth
    for frame in clouds.dataset:
        if not (frame.has("target_depth") and frame.has("semantics")):
            raise UsageError(
                f"{frame.where} frame {frame.id}: the study of the sigma filter needs true depth and classes"
            )
        completed = depths.of(frame, recipe.depth, recipe.rows)
        if not completed.has_surfaces:
            raise UsageError("the study of the sigma filter needs depth with two surfaces (a twin-surface network)")
        objects = object_score(frame.semantics, recipe.settings.classes) > 0
        sweep.add(completed, label_noise(completed.depth, frame.target_depth, objects, Taxonomy()))
    removed, lost = sweep.shares()
    numbers: dict[str, float] = {}
    for i, low in enumerate(LOWS):
        for j, gap in enumerate(GAPS):
            view = f"{low:g}-{1 - low:g}, {gap:g} m"
            numbers |= {f"{view}/removed": float(removed[i, j]), f"{view}/lost": float(lost[i, j])}
    return Outcome(numbers)


STUDIES = {"points": _points, "sigma": _sigma}
