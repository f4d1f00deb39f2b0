"""Runs of kinds "completer" (score one that is there) and "selection" (train the bundled network, then score it).

Settings: `completer`, a name for `completers.open_completer`, and its `options`; or `loss` ("mixture", "l2"), `width`
and `start` (weights to grow from, "" for none). Scores: those of the completion tables at 64 and 16 rows, "64/mae_mm".
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.experiments.bundled import ROWS
from pipeline.experiments.runs import Context, Cost, Outcome
from pipeline.experiments.tables import Recipe
from pipeline.experiments.worlds import open_world, world_identity

if TYPE_CHECKING:
    from completion.infer import Completer
    from completion.train import TrainSettings
    from completion.types import DepthFrame
    from pipeline.data import Dataset, Frame

KEPT = ("mae_mm", "rmse_mm", "tmae_mm", "mixed_percent", "edge_tmae_mm")


@dataclass(frozen=True)
class BundledBudget:
    """Data and training.

    train_frames, test_frames   frames of the synthetic world; size (height, width) of images, None for KITTI's own
    crop, batch     training crops of a step
    steps           of a network from random weights; grown_steps: of one that begins with trained weights
    beam_strides       every n-th LiDAR ring, n drawn for each crop
    seconds_per_step, seconds_per_test_frame   on one core of a 2-core AMD EPYC server (AVX2)
    """

    train_frames: int
    test_frames: int
    size: tuple[int, int] | None
    crop: tuple[int, int]
    batch: int
    steps: int
    grown_steps: int
    beam_strides: tuple[int, ...] = (1, 2, 4, 4, 8)
    calibration_jitter: float = 0.03
    learning_rate: float = 1e-3
    seconds_per_step: float = 0.0
    seconds_per_test_frame: float = 0.0
    seconds_per_data_frame: float = 2.1


BUDGETS: Mapping[str, BundledBudget] = {
    "smoke": BundledBudget(2, 2, (96, 320), (64, 96), 2, 2, 2, seconds_per_step=0.1, seconds_per_test_frame=0.3),
    "small": BundledBudget(160, 200, None, (128, 416), 4, 800, 300, seconds_per_step=0.6, seconds_per_test_frame=0.9),
    # The schedule of configs/weights/completion-small.yaml and completion-large.yaml.
    "paper": BundledBudget(800, 200, None, (192, 512), 4, 4000, 700, seconds_per_step=1.0, seconds_per_test_frame=0.9),
}


def data_identity(data: Path | None, budget: BundledBudget) -> Any:
    """See `worlds.world_identity`."""
    return world_identity(data, budget.train_frames, budget.test_frames, budget.size)


def cost(recipe: Recipe, budget: BundledBudget) -> Cost:
    """Steps and test frames by their measured seconds; frames once."""
    frames = budget.train_frames + budget.test_frames
    seconds = budget.test_frames * budget.seconds_per_test_frame
    if recipe.kind == "selection":
        seconds += _steps(recipe, budget) * budget.seconds_per_step * (int(recipe.settings["width"]) / 24) ** 2
    return Cost(seconds, 10e6, frames * budget.seconds_per_data_frame, frames * 5e6)


def _steps(recipe: Recipe, budget: BundledBudget) -> int:
    return budget.grown_steps if recipe.settings["start"] else budget.steps


def run(recipe: Recipe, context: Context) -> Outcome:
    """Scores a completer, trained first where the recipe says so; a killed training continues."""
    from pipeline.run_folder.completers import open_completer

    budget: BundledBudget = context.budget
    world = open_world(
        context.out / "data", context.data, budget.train_frames, budget.test_frames, budget.size, context.say
    )
    name: str | Path = str(recipe.settings.get("completer", ""))
    if recipe.kind == "selection":
        name = _trained(recipe, world.train, context)
    options = recipe.settings.get("options") or {}
    return score(open_completer(str(name), backend="auto", options=options), world.test)


def train_settings(recipe: Recipe, budget: BundledBudget, seed: int) -> TrainSettings:
    """Those of configs/weights/completion-*.yaml but for the loss, the crops and the number of steps."""
    from completion.models import default_spec
    from completion.samples import Augmentation
    from completion.train import TrainSettings
    from completion.training_loss import LossSettings

    start = str(recipe.settings["start"])
    steps = _steps(recipe, budget)
    return TrainSettings(
        default_spec("selection", width=int(recipe.settings["width"])),
        LossSettings(str(recipe.settings["loss"]), max_depth=90, above_top_ring=0.3, edge_weight=1.0),
        Augmentation(crop=budget.crop, flip=0.5, jitter=0.3, gamma=0.4, noise=6.0, drop=0.15, edge_crops=0.3),
        seed=seed,
        epochs=1,
        steps_per_epoch=steps,
        batch_size=budget.batch,
        accumulate=1,
        crops_per_frame=2,
        learning_rate=budget.learning_rate * (0.6 if start else 1),
        schedule="cosine",
        warmup_steps=min(50, steps // 10),
        clip_gradient=1.0,
        scale_weights=((0, (1,)),),
        warm_start=start or None,
        # A squared loss teaches the mean of the mixture, so that is what it is read by.
        decoding="expected" if recipe.settings["loss"] == "l2" else "median",
        log_every=max(1, steps // 20),
        save_every=max(1, steps // 8),
    )


def _trained(recipe: Recipe, frames: Dataset, context: Context) -> Path:
    from completion.train import train
    from pipeline.training.stage import DepthSamples

    budget: BundledBudget = context.budget
    samples = DepthSamples(frames, budget.beam_strides, budget.calibration_jitter)
    train(train_settings(recipe, budget, context.seed), samples, context.folder, facts={"experiment": "bundled"})
    return context.folder / "last.safetensors"


def test_frames(frame: Frame) -> Iterator[tuple[int, DepthFrame]]:
    """The frame as a LiDAR of each number of rows sees it; truth where the full scan measures (to 80 m)."""
    from completion.diagnostics import measured_region
    from completion.types import DepthFrame
    from pipeline.experiments.inputs import lidar_points
    from pipeline.geometry.project import project_points

    truth = measured_region(DepthFrame(frame.image, frame.sparse_depth, frame.target_depth))
    for rows in ROWS:
        sparse = project_points(lidar_points(frame, rows), frame.calibration, frame.image_size)
        yield rows, DepthFrame(frame.image, sparse, truth)


def score(completer: Completer, dataset: Dataset) -> Outcome:
    """Means over frames, and the values of every frame."""
    from pipeline.experiments.scoring import frame_scores

    values: dict[str, list[float]] = {}
    for frame in dataset:
        for rows, seen in test_frames(frame):
            assert seen.target is not None
            found = frame_scores(completer.complete(seen.sparse, seen.image).depth, seen.target)
            for name in KEPT:
                values.setdefault(f"{rows}/{name}", []).append(found[name])
    return Outcome({name: float(np.nanmean(column)) for name, column in values.items()}, values)
