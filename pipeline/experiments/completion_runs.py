"""Runs of kind "completion": train one network on stored frames, score it on others in every way a table asks for.

Settings of a recipe: network, loss, gamma, rows (64, 32, 16, 8, 0 = monocular), colour, target ("clean" or
"semi_dense": what it is trained on), scene ("street", or "samples_500": random samples in place of LiDAR rows); or
compare: two "network loss" names whose pixel errors are compared; or audit: the semi-dense ground truth is measured; or
completer: module:Class with `options`, a method of one's own, which is scored as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.base.errors import UsageError
from pipeline.experiments import frames as stored
from pipeline.experiments.budgets import COMPLETION, CompletionBudget
from pipeline.experiments.completion_inputs import (
    NETWORKS,
    default_decoding,
    image_of,
    load_remembered,
    load_weights,
    model_spec,
    random_samples,
    sparse_of,
    test_frame,
    truth,
)
from pipeline.experiments.runs import Context, Cost, Outcome
from pipeline.experiments.tables import Recipe

if TYPE_CHECKING:
    from completion.samples import TrainingSample
    from completion.train import TrainSettings
    from completion.types import DepthFrame

BUDGETS = COMPLETION
DIAGNOSED = 12  # test frames for the grey-image score and sigma's statistics


def data_identity(data: Path | None, budget: CompletionBudget) -> Any:
    """See `frames.identity`."""
    return stored.identity(data, budget)


def cost(recipe: Recipe, budget: CompletionBudget) -> Cost:
    """Steps and test frames by the measured seconds of the network; data once."""
    frames = budget.train_frames + budget.test_frames
    seconds, size = frames * budget.seconds_per_data_frame, frames * 13.0 * _pixels(budget)
    if "network" not in recipe.settings or "completer" in recipe.settings:
        return Cost(budget.test_frames * 0.2, 1e6, seconds, size)
    name = cost_name(recipe)
    train, test = budget.seconds_per_step.get(name, 0.0), budget.seconds_per_test_frame.get(name, 0.0)
    training = budget.steps * train + budget.test_frames * test
    return Cost(training, 5e6 * (budget.channels / 16) ** 2, seconds, size)


def cost_name(recipe: Recipe) -> str:
    """Key of the measured times in the budget: "multistack", "nlspn", "resnet18" or "resnet18 dc"."""
    network = str(recipe.settings["network"]).split("_")[0]
    return f"{network} dc" if recipe.settings["loss"] == "dc" else network


def _pixels(budget: CompletionBudget) -> int:
    height, width = budget.size or (375, 1242)
    return (budget.test_rows or height) * (budget.test_columns or width)


def run(recipe: Recipe, context: Context) -> Outcome:
    """Trains (or continues), scores; the weights stay in the run's folder."""
    if "compare" in recipe.settings:
        from pipeline.experiments.comparison import compare

        return compare(recipe, context)
    if "audit" in recipe.settings:
        from pipeline.experiments.comparison import audit

        return audit(context)
    from pipeline.experiments.scoring import completers, save_examples, score

    if "completer" in recipe.settings:
        return _score_own(recipe, context)
    _check(recipe, context.budget)
    noisy = ("train", "test") if recipe.settings["target"] == "semi_dense" else ()
    train_paths, test_paths = stored.ensure_frames(context.out, context.data, context.budget, context.say, noisy)
    settings = train_settings(recipe, context.budget, context.seed)
    weights = _train(settings, _Samples(recipe, train_paths), context)
    model = load_weights(settings.model, weights)
    tests = [test_frame(recipe, path) for path in test_paths]
    by_decoding = completers(model, settings.model, default_decoding(settings.model))
    save_examples(context.folder, next(iter(by_decoding.values())), tests)
    return score(by_decoding, tests, DIAGNOSED)


def _score_own(recipe: Recipe, context: Context) -> Outcome:
    """A method of one's own on the test frames: nothing is trained."""
    from pipeline.experiments.scoring import save_examples, score
    from pipeline.run_folder.completers import open_completer

    completer = open_completer(str(recipe.settings["completer"]), options=recipe.settings.get("options"))
    _, test_paths = stored.ensure_frames(context.out, context.data, context.budget, context.say)
    tests = [test_frame(recipe, path) for path in test_paths]
    save_examples(context.folder, completer, tests)
    return score({"own": completer}, tests, DIAGNOSED)


def _check(recipe: Recipe, budget: CompletionBudget) -> None:
    settings = recipe.settings
    if settings.get("rows") not in (*stored.ROWS, 0):
        raise UsageError(f"rows: expected one of {stored.ROWS} or 0, got {settings.get('rows')!r}")
    if settings["network"] not in NETWORKS:
        raise UsageError(f"network: expected one of {', '.join(NETWORKS)}, got {settings['network']!r}")
    model_spec(recipe, budget)


def train_settings(recipe: Recipe, budget: CompletionBudget, seed: int) -> TrainSettings:
    """Settings of `completion.train`; one "epoch" is the whole run, so that the thesis' schedules scale."""
    from completion.samples import Augmentation
    from completion.train import TrainSettings
    from completion.training_loss import LossSettings

    loss_settings = LossSettings(str(recipe.settings["loss"]), gamma=float(recipe.settings.get("gamma", 2.0)))
    return TrainSettings(
        model_spec(recipe, budget),
        loss_settings,
        Augmentation(crop=budget.crop, flip=0.5, jitter=0.1),
        seed=seed,
        epochs=1,
        steps_per_epoch=budget.steps,
        batch_size=budget.batch,
        accumulate=1,
        learning_rate=budget.learning_rate,
        schedule=budget.schedule,
        halve_every=1 / 6,
        warmup_steps=min(20, budget.steps // 10),
        scale_weights=((0, (1, 1, 1)), (1 / 3, (1, 0.1, 0.1)), (2 / 3, (1, 0, 0))),
        log_every=max(1, budget.steps // 10),
        save_every=max(1, budget.steps // 4),
        save_seconds=60.0,
    )


def _train(settings: TrainSettings, samples: _Samples, context: Context) -> Path:
    """The last weights of the run; a finished training is not touched."""
    from completion.train import train

    train(settings, samples, context.folder, facts={"experiment": context.folder.name})
    return context.folder / "last.safetensors"


class _Samples:
    """Stored training frames as a recipe sees them."""

    def __init__(self, recipe: Recipe, paths: Sequence[Path]) -> None:
        self.recipe, self.paths = recipe, list(paths)

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int, /) -> DepthFrame | TrainingSample:
        from completion.samples import TrainingSample
        from completion.types import DepthFrame

        frame = load_remembered(self.paths[index])
        target = truth(frame, str(self.recipe.settings["target"]), self.paths[index])
        sample = DepthFrame(image_of(self.recipe, frame), sparse_of(self.recipe, frame, self.paths[index]), target)
        if self.recipe.settings["scene"] != "samples_500":
            return sample
        return TrainingSample(sample, lambda rng: random_samples(frame.clean, rng))
