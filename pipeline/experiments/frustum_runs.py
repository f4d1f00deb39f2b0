"""Runs of kind "frustum": Frustum PointNet trained on a row's own points, its AP on the test frames (Table 3.4).

Settings of a recipe: `points` ("raw", "ma", "dc") and `rows` (LiDAR rows).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from auglidar_base.atomic import write_text
from auglidar_base.errors import SettingsError
from detection.evaluation.bootstrap import Resampling
from detection.evaluation.difficulty import DifficultyRule
from pipeline.base.errors import DataError, UsageError
from pipeline.base.paths import RunFolder
from pipeline.base.settings import nearest_name
from pipeline.experiments import detection_scores as scores
from pipeline.experiments.cloud_cache import short_hash
from pipeline.experiments.frustum_budget import FRUSTUM, FrustumBudget
from pipeline.experiments.frustum_points import COMPLETED, FrustumFrames, completion_of
from pipeline.experiments.runs import Context, Cost, Outcome
from pipeline.experiments.tables import Recipe
from pipeline.experiments.worlds import open_world, world_identity
from pipeline.run_folder.frame_outputs import FrameOutputs

if TYPE_CHECKING:
    from auglidar_base.progress import TrainProgress
    from detection.frustum.regions import Region
    from detection.frustum.train import FrustumTrainSettings
    from detection.kitti_format import KittiObject
    from pipeline.data import Frame

BUDGETS: Mapping[str, FrustumBudget] = FRUSTUM
POINTS = ("raw", *COMPLETED)
_MEGABYTE = 1e6


def data_identity(data: Path | None, budget: FrustumBudget) -> Any:
    """Plain values that say which frames a run uses."""
    return world_identity(data, budget.train_frames, budget.test_frames, budget.size)


def cost(recipe: Recipe, budget: FrustumBudget) -> Cost:
    """Training and detection; frames are made once per experiment folder."""
    frames = budget.train_frames + budget.test_frames
    dense = frames * budget.seconds_per_frame if recipe.settings["points"] != "raw" else 0.0
    seconds = budget.steps * budget.seconds_per_step + dense + 0.1 * budget.test_frames
    return Cost(seconds, 25 * _MEGABYTE, budget.seconds_per_data_frame * frames, 5 * _MEGABYTE * frames)


def run(recipe: Recipe, context: Context) -> Outcome:
    """Trains and tests on one kind of points; continues from what a killed run left in its folder."""
    budget: FrustumBudget = context.budget
    which, rows = _checked(recipe)
    world = open_world(
        context.out / "data", context.data, budget.train_frames, budget.test_frames, budget.size, context.say
    )
    completion = completion_of(which, rows, world.train, context) if which != "raw" else None
    train, test = (
        FrustumFrames(part, rows, completion, context.out / "data" / f"of-{short_hash(str(part.root))}")
        for part in (world.train, world.test)
    )
    regions_of = open_regions(budget.boxes)
    weights = _trained(budget, train, context)
    labels, found = detect(weights, test, regions_of, context)
    return outcome_of(labels, found, world.rule, budget.resamples)


def _checked(recipe: Recipe) -> tuple[str, int]:
    which = str(recipe.settings["points"])
    if which not in POINTS:
        raise UsageError(f"points: {nearest_name(which, POINTS)}, got {which!r}")
    return which, int(recipe.settings["rows"])


def _trained(budget: FrustumBudget, frames: FrustumFrames, context: Context) -> Path:
    """The weights of the run. UsageError for frames or settings that cannot be trained on."""
    from detection.frustum.train import train_frustums

    def report(progress: TrainProgress) -> None:
        context.say(f"  step {progress.step} of {progress.steps}, loss {progress.losses['loss']:.2f}")

    try:
        settings = train_settings(budget, context.seed)
        return train_frustums(settings, frames, context.folder / "training", progress=report)
    except SettingsError as error:
        raise UsageError(str(error)) from None


def train_settings(budget: FrustumBudget, seed: int) -> FrustumTrainSettings:
    """What `detection.frustum.train` is told: the same for every row."""
    from detection.frustum.train import FrustumTrainSettings

    return FrustumTrainSettings(
        steps=budget.steps,
        batch_size=budget.batch,
        learning_rate=budget.learning_rate,
        save_every=max(1, min(500, budget.steps)),
        seed=seed,
        channels=3,
        classes=budget.classes,
        points=budget.points,
        copies=budget.copies,
        decay_samples=budget.decay_samples,
        log_every=max(1, min(50, budget.steps)),
    )


def open_regions(boxes: str) -> Callable[[Frame], list[Region]]:
    """The 2D boxes of a frame: its labels', those of a published list, or those of a folder of result files."""
    from detection.frustum.regions import object_regions, parse_detection_list
    from detection.text import decode_text
    from pipeline.data.kitti_object import read_labels

    if boxes == "labels":
        return lambda frame: object_regions(frame.labels)
    path = Path(boxes)
    if path.is_dir():
        # A frame without a file has no box: detectors need not write empty ones.
        return lambda frame: (
            object_regions(read_labels(path / f"{frame.id}.txt", scored=True))
            if (path / f"{frame.id}.txt").is_file()
            else []
        )
    if not path.is_file():
        raise UsageError(
            f"boxes: expected 'labels', a list of 2D detections or a folder of result files, got {boxes!r}"
        )
    try:
        listed = parse_detection_list(decode_text(path.read_bytes()), where=path.name)
    except ValueError as error:
        raise DataError(path, "a list of 2D detections (image class score x1 y1 x2 y2)", str(error)) from None
    return lambda frame: listed.get(frame.id, [])


def detect(
    weights: Path, frames: FrustumFrames, regions_of: Callable[[Frame], list[Region]], context: Context
) -> tuple[dict[str, list[KittiObject]], dict[str, list[KittiObject]]]:
    """Labels and detections of the test frames by id; those that are there already are read."""
    from detection.frustum.infer import FrustumDetector, load_frustum_detector

    loaded = load_frustum_detector(weights, seed=context.seed)
    detector = FrustumDetector(loaded.model, loaded.device, context.budget.points, context.seed)
    run_folder = RunFolder(context.folder)
    labels, found = {}, {}
    for frame in frames.dataset:
        files = FrameOutputs(run_folder, frame.id)
        if not run_folder.detections(frame.id).is_file():
            files.write_detections(detector.detect(frames.point_frame(frame), regions_of(frame)))
        labels[frame.id], found[frame.id] = frame.labels, files.read_detections()
    write_text(context.folder / "boxes.txt", f"{sum(map(len, found.values()))} boxes from {context.budget.boxes}\n")
    return labels, found


def outcome_of(labels: scores.Objects, found: scores.Objects, rule: DifficultyRule, resamples: int) -> Outcome:
    """AP with 40 recall points as everywhere, and with the 11 of KITTI when the thesis was written ("r11/...")."""
    evaluation = scores.evaluation_of(labels, found, rule)
    resampling = Resampling(resamples)
    draws = scores.ap_draws(evaluation, resampling)
    eleven = scores.ap_numbers(scores.evaluation_of(labels, found, rule, recall=11))
    numbers = scores.ap_numbers(evaluation) | {f"r11/{name}": value for name, value in eleven.items()}
    return Outcome(numbers, intervals=scores.intervals_of(draws, resampling), draws=draws)
