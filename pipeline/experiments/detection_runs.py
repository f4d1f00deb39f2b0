"""Runs of kind "detection": clouds of a recipe, a detector trained on them, its AP on clouds of the test frames.

Settings of a recipe: `input` (fields of `InputRecipe`), `detector` (a name in the budget), `rows` (LiDAR rows), and
`test_input` (fields that differ in the test clouds: train clean, test noisy). A `detector` may be module:Class with
`options`, a detector of one's own: it is tested as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from detection.evaluation.bootstrap import Resampling
from pipeline.base.errors import UsageError
from pipeline.base.paths import RunFolder
from pipeline.base.progress import duration
from pipeline.base.settings import nearest_name, plain, with_changes
from pipeline.experiments import detection_scores as scores
from pipeline.experiments.cloud_cache import CloudCache, DepthCache, short_hash
from pipeline.experiments.common_pretraining import Mixture, start_inputs
from pipeline.experiments.detection_budget import DEFAULT_DETECTOR, DETECTION, DetectionBudget, DetectorChoice
from pipeline.experiments.example import write_example
from pipeline.experiments.inputs import InputRecipe
from pipeline.experiments.runs import Context, Cost, Outcome
from pipeline.experiments.tables import Recipe
from pipeline.experiments.worlds import World, open_world, world_identity
from pipeline.pointcloud.taxonomy import LABELS
from pipeline.run_folder.detectors import ObjectDetector, open_detector
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.own_methods import is_own

if TYPE_CHECKING:
    from detection.kitti_format import KittiObject
    from detection.train import LabelledFrames, TrainProgress, TrainSettings
    from pipeline.data import Dataset

BUDGETS: Mapping[str, DetectionBudget] = DETECTION
_MEGABYTE = 1e6


@dataclass(frozen=True)
class DetectionRecipe:
    """Which clouds train and test which detector."""

    detector: str
    train_input: InputRecipe
    test_input: InputRecipe

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> DetectionRecipe:
        """From the settings of a recipe. UsageError for an unknown field."""
        known = ("input", "detector", "rows", "test_input", "options")
        for key in settings:
            if key not in known:
                raise UsageError(f"detection recipe: unknown setting {key!r}; {nearest_name(key, known)}")
        base = InputRecipe(rows=int(settings.get("rows", 64)))
        train_input = with_changes(base, settings.get("input", {}), "input")
        test_input = with_changes(train_input, settings.get("test_input", {}), "test_input")
        return cls(str(settings.get("detector", DEFAULT_DETECTOR)), train_input, test_input)


def data_identity(data: Path | None, budget: DetectionBudget) -> Any:
    """Plain values that say which frames a run uses."""
    return world_identity(data, budget.train_frames, budget.test_frames, budget.size)


def cost(recipe: Recipe, budget: DetectionBudget) -> Cost:
    """Training and detection; frames and completed depth are made once per experiment folder."""
    wanted = DetectionRecipe.of(recipe.settings)
    if is_own("detection", wanted.detector):
        return Cost(budget.test_frames * 0.5, _MEGABYTE, budget.seconds_per_data_frame * budget.test_frames)
    choice = detector_choice(wanted, budget)
    frames = budget.train_frames + budget.test_frames
    seconds = budget.steps * choice.seconds_per_step * budget.batch / 2 + budget.test_frames * choice.seconds_per_frame
    # Clouds are shared by seeds and detectors: a table has some six kinds of them.
    clouds = (5 * _MEGABYTE + 6 * 26.0 * budget.cloud_points) * frames
    trained = budget.part_for(recipe.settings).detectors.values()
    start = {one.preset: one.start_steps * one.seconds_per_step * budget.batch / 2 for one in trained}
    return Cost(seconds + 0.15 * frames, 5 * _MEGABYTE, budget.seconds_per_data_frame * frames, clouds, start)


def detector_choice(recipe: DetectionRecipe, budget: DetectionBudget) -> DetectorChoice:
    """The budget's network for a detector of the thesis. UsageError when it has none."""
    if recipe.detector not in budget.detectors:
        raise UsageError(f"unknown detector {recipe.detector!r}; {nearest_name(recipe.detector, budget.detectors)}")
    return budget.detectors[recipe.detector]


def world_of(context: Context) -> World:
    """The frames of a run."""
    budget = context.budget
    return open_world(
        context.out / "data", context.data, budget.train_frames, budget.test_frames, budget.size, context.say
    )


def clouds_of(dataset: Dataset, recipe: InputRecipe, context: Context) -> CloudCache:
    """The clouds of a data set by a recipe, made if they are missing."""
    from pipeline.semantics.sources import open_semantics

    budget: DetectionBudget = context.budget
    name = "boxes" if recipe.masks == "boxes" else budget.masks
    masks = open_semantics(name) if recipe.settings.needs_semantics else None
    depth = DepthCache(context.out / "data" / f"of-{short_hash(str(dataset.root))}", budget.completer)
    cache = CloudCache(dataset, recipe, depth, masks, name if masks is not None else "", budget.cloud_points)
    cache.prepare(context.say)
    return cache


def run(recipe: Recipe, context: Context) -> Outcome:
    """Trains and tests one detector; continues from what a killed run left in its folder."""
    wanted = DetectionRecipe.of(recipe.settings)
    world = world_of(context)
    own, options = is_own("detection", wanted.detector), recipe.settings.get("options")
    name = wanted.detector if own else str(train_detector(wanted, world.train, context))
    clouds = clouds_of(world.test, wanted.test_input, context)
    labels, detections = detect(open_detector(name, seed=context.seed, options=options), clouds, context)
    write_example(context.folder / "example.npz", clouds, labels, detections)
    evaluation = scores.evaluation_of(labels, detections, world.rule)
    resampling = Resampling(context.budget.resamples)
    draws = scores.ap_draws(evaluation, resampling)
    numbers = scores.ap_numbers(evaluation) | scores.where_lost(evaluation) | cloud_numbers(clouds)
    return Outcome(numbers, intervals=scores.intervals_of(draws, resampling), draws=draws)


def train_settings(recipe: DetectionRecipe, context: Context) -> TrainSettings:
    """What `detection.train` is told: the same steps for every row of a table."""
    from detection.data_augmentation import SceneAugmentation
    from detection.train import TrainSettings

    budget: DetectionBudget = context.budget
    choice = detector_choice(recipe, budget)
    options = {**choice.options, "features": [*choice.features, *recipe.train_input.extra_features]}
    if choice.dense:
        options[choice.dense] = recipe.train_input.settings.completed
    scene = SceneAugmentation(rotation=0.785, scale=0.05, flip=0.5) if budget.augmented else None
    every = max(1, min(50, budget.steps))
    return TrainSettings(
        preset=choice.preset,
        options=options,
        steps=budget.steps,
        batch_size=budget.batch,
        seed=context.seed,
        learning_rate=budget.peak,
        scene=scene,
        save_every=every,
        log_every=every,
    )


def train_detector(recipe: DetectionRecipe, frames: Dataset, context: Context) -> Path:
    """Weights for a recipe; runs that differ only in their test clouds share them."""
    clouds = clouds_of(frames, recipe.train_input, context)
    begun = detector_choice(recipe, context.budget).start_steps > 0
    start = common_pretraining(recipe.detector, frames, context) if begun else None
    return _trained(train_settings(recipe, context), clouds, [clouds.folder.name], start, context)


def common_pretraining(detector: str, frames: Dataset, context: Context) -> Path:
    """Weights that every row with this detector begins with, whatever its seed and input; trained once."""
    sources = [clouds_of(frames, kind, context) for kind in start_inputs(frames[0])]
    recipe = DetectionRecipe(detector, InputRecipe(), InputRecipe())
    choice = detector_choice(recipe, context.budget)
    first = common_pretraining(choice.first_stage, frames, context) if choice.first_stage else None
    settings = replace(train_settings(recipe, context), steps=choice.start_steps, seed=0)
    return _trained(settings, Mixture(sources), [source.folder.name for source in sources], first, context)


def _trained(
    settings: TrainSettings, samples: LabelledFrames, clouds: list[str], start: Path | None, context: Context
) -> Path:
    """Weights in OUT/data/trained-HASH, trained from `start` (or nothing) or from the last saved state."""
    from detection.checkpoints import read_card
    from detection.train import train

    record = [plain(settings), clouds, len(samples), "" if start is None else start.parent.name]
    weights = context.out / "data" / f"trained-{short_hash(record)}" / "last.safetensors"
    if weights.is_file() and read_card(weights)["steps"] == settings.steps:
        return weights

    def report(progress: TrainProgress) -> None:
        text = f"step {progress.step} of {progress.steps}, loss {progress.losses['loss']:.2f}"
        context.say(f"  {text}, about {duration(progress.eta)} left")

    begun = settings if start is None else replace(settings, warm_start=str(start))
    return train(begun, samples, weights.parent, progress=report)


def detect(
    detector: ObjectDetector, clouds: CloudCache, context: Context
) -> tuple[dict[str, list[KittiObject]], dict[str, list[KittiObject]]]:
    """Labels and detections of the test frames by id; those that are there already are read."""
    from detection.results import result_objects

    run_folder = RunFolder(context.folder)
    labels, found = {}, {}
    for frame in clouds.dataset:
        files = FrameOutputs(run_folder, frame.id)
        if not run_folder.detections(frame.id).is_file():
            cloud = clouds.point_frame(frame)
            files.write_detections(result_objects(detector.detect(cloud), cloud))
        labels[frame.id], found[frame.id] = frame.labels, files.read_detections()
    return labels, found


def cloud_numbers(clouds: CloudCache) -> dict[str, float]:
    """Mean points of the test clouds, and percent of each kind and on objects among points whose truth is known."""
    kinds, objects, points = np.zeros(len(LABELS)), 0.0, 0.0
    for frame_id in clouds.dataset.ids:
        cloud = clouds.read(frame_id)
        kinds += np.bincount(cloud.kind, minlength=len(LABELS))
        objects += float(cloud.objects[cloud.kind > 0].sum())
        points += len(cloud.points)
    known = max(float(kinds[1:].sum()), 1.0)
    numbers = {f"cloud/{name} %": 100 * float(count) / known for name, count in zip(LABELS[1:], kinds[1:])}
    return {**numbers, "cloud/object %": 100 * objects / known, "cloud/points": points / max(len(clouds), 1)}
