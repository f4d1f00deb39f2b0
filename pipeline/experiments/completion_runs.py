"""Runs of kind "completion": train one network on stored frames, score it on others in every way a table asks for.

Settings of a recipe: network, loss, gamma, rows (64, 32, 16, 8, 0 = monocular), colour, target ("clean" or
"semi_dense": what it is trained on), scene ("street", or "samples_500": random samples in place of LiDAR rows); or
compare: two "network loss" names whose pixel errors are compared; or audit: the semi-dense ground truth is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import UsageError
from pipeline.experiments import frames as stored
from pipeline.experiments.budgets import COMPLETION, CompletionBudget
from pipeline.experiments.frames import StoredFrame
from pipeline.experiments.runs import Context, Cost, Outcome
from pipeline.experiments.tables import Recipe

if TYPE_CHECKING:
    from torch import nn

    from completion.models import ModelSpec
    from completion.samples import TrainingSample
    from completion.train import TrainSettings
    from completion.types import DepthFrame

BUDGETS = COMPLETION
SAMPLES = 500
DIAGNOSED = 12  # test frames for the grey-image score and sigma's statistics
# network -> (builder for a loss on one depth, for twin surfaces, for coefficients)
NETWORKS: dict[str, tuple[str | None, str | None, str | None]] = {
    "multistack": ("msg_chn", "twise", None),
    "resnet18": ("sparse_to_dense", "twise_resnet", "resnet_dc_to_dc"),
    "resnet18_plain": ("resnet_depth_to_depth", None, None),
    "resnet18_dc_input": ("resnet_dc_to_depth", None, None),
    "resnet18_depth_input": (None, None, "resnet_depth_to_dc"),
}


def data_identity(data: Path | None, budget: CompletionBudget) -> Any:
    """See `frames.identity`."""
    return stored.identity(data, budget)


def cost(recipe: Recipe, budget: CompletionBudget) -> Cost:
    """Steps and test frames by the measured seconds of the network; data once."""
    frames = budget.train_frames + budget.test_frames
    seconds, size = frames * budget.seconds_per_data_frame, frames * 13.0 * _pixels(budget)
    if "network" not in recipe.settings:
        return Cost(budget.test_frames * 0.2, 1e6, seconds, size)
    name = cost_name(recipe)
    train, test = budget.seconds_per_step.get(name, 0.0), budget.seconds_per_test_frame.get(name, 0.0)
    training = budget.steps * train + budget.test_frames * test
    return Cost(training, 5e6 * (budget.channels / 16) ** 2, seconds, size)


def cost_name(recipe: Recipe) -> str:
    """Key of the measured times in the budget: "multistack", "resnet18" or "resnet18 dc"."""
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
    from completion.infer import NetworkCompleter
    from pipeline.experiments.scoring import save_examples, score

    _check(recipe, context.budget)
    noisy = ("train", "test") if recipe.settings["target"] == "semi_dense" else ()
    train_paths, test_paths = stored.ensure_frames(context.out, context.data, context.budget, context.say, noisy)
    settings = train_settings(recipe, context.budget, context.seed)
    weights = _train(settings, _Samples(recipe, train_paths), context)
    model = load_weights(settings.model, weights)
    tests = [test_frame(recipe, path) for path in test_paths]
    completer = NetworkCompleter(model, settings.model, read_out=default_read_out(settings.model))
    save_examples(context.folder, completer, tests)
    return score(completer, tests, settings.model, DIAGNOSED)


def _check(recipe: Recipe, budget: CompletionBudget) -> None:
    settings = recipe.settings
    if settings.get("rows") not in (*stored.ROWS, 0):
        raise UsageError(f"rows: expected one of {stored.ROWS} or 0, got {settings.get('rows')!r}")
    if settings["network"] not in NETWORKS:
        raise UsageError(f"network: expected one of {', '.join(NETWORKS)}, got {settings['network']!r}")
    model_spec(recipe, budget)


def model_spec(recipe: Recipe, budget: CompletionBudget) -> ModelSpec:
    """The network of a recipe at the budget's width. UsageError for a loss that the network does not offer."""
    from completion.models import default_spec, with_rgb

    network, loss = str(recipe.settings["network"]), str(recipe.settings["loss"])
    plain, twin, coefficients = NETWORKS[network]
    name = {"twin": twin, "dc": coefficients}.get(loss, plain)
    if name is None:
        raise UsageError(f"network {network!r} has no head for the loss {loss!r}")
    arguments: dict[str, Any] = {"channels": budget.channels, "init": budget.init}
    if network == "multistack":
        arguments |= {"extra_skips": False}
    else:
        arguments = {"width": budget.resnet_width}
        if "dc" in name:
            arguments |= {"count": budget.bins, "size": 80.0 / budget.bins}
    spec = default_spec(name, **arguments)
    if budget.depth_unit and spec.output != "coefficients":
        spec = replace(spec, depth_unit=float(budget.depth_unit))
    return with_rgb(spec, budget.rgb) if budget.rgb != "unit" else spec


def default_read_out(spec: ModelSpec) -> str:
    """How the rows without a view are read: coefficients by three of them, everything else as usual."""
    return {"twin": "fused", "coefficients": "peak", "depth": "depth"}[spec.output]


def train_settings(recipe: Recipe, budget: CompletionBudget, seed: int) -> TrainSettings:
    """Settings of `completion.train`; one "epoch" is the whole run, so that the thesis' schedules scale."""
    from completion.objectives import Objective
    from completion.samples import Augmentation
    from completion.train import TrainSettings

    objective = Objective(str(recipe.settings["loss"]), gamma=float(recipe.settings.get("gamma", 2.0)))
    return TrainSettings(
        model_spec(recipe, budget),
        objective,
        Augmentation(crop=budget.crop, flip=0.5, jitter=0.1),
        seed=seed,
        epochs=1,
        steps_per_epoch=budget.steps,
        batch=budget.batch,
        accumulate=1,
        learning_rate=budget.learning_rate,
        schedule=budget.schedule,
        halve_every=1 / 6,
        warmup_steps=min(20, budget.steps // 10),
        scale_weights=((0, (1, 1, 1)), (1 / 3, (1, 0.1, 0.1)), (2 / 3, (1, 0, 0))),
        log_every=max(1, budget.steps // 10),
        checkpoint_steps=max(1, budget.steps // 4),
        checkpoint_seconds=60.0,
    )


def _train(settings: TrainSettings, samples: _Samples, context: Context) -> Path:
    """The last weights of the run; a finished training is not touched."""
    from completion.train import train

    train(settings, samples, context.folder, facts={"experiment": context.folder.name})
    return context.folder / "last.safetensors"


def load_weights(spec: ModelSpec, weights: Path) -> nn.Module:
    """The network of a finished training."""
    from safetensors.torch import load_file

    from completion.models import build_model

    model = build_model(spec)
    model.load_state_dict(load_file(weights))
    return model


def _load(path: Path) -> StoredFrame:
    """A frame, from memory when it was read before (its second ground truth may be made later)."""
    return _remembered(path, stored.semi_dense_file(path).is_file())


@lru_cache(maxsize=512)
def _remembered(path: Path, with_semi_dense: bool) -> StoredFrame:
    """Frames stay in memory over the runs of a table (about 1 MB each)."""
    return stored.load(path)


class _Samples:
    """Stored training frames as a recipe sees them."""

    def __init__(self, recipe: Recipe, paths: Sequence[Path]) -> None:
        self.recipe, self.paths = recipe, list(paths)

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int, /) -> DepthFrame | TrainingSample:
        from completion.samples import TrainingSample
        from completion.types import DepthFrame

        frame = _load(self.paths[index])
        target = truth(frame, str(self.recipe.settings["target"]), self.paths[index])
        sample = DepthFrame(image_of(self.recipe, frame), sparse_of(self.recipe, frame, self.paths[index]), target)
        if self.recipe.settings["scene"] != "samples_500":
            return sample
        return TrainingSample(sample, lambda rng: random_samples(frame.clean, rng))


def truth(frame: StoredFrame, kind: str, path: Path) -> NDArray[np.float32]:
    """Clean or semi-dense ground truth. UsageError when the data has no pseudo ground truth."""
    if kind == "clean":
        return frame.clean
    if frame.semi_dense is None:
        raise UsageError(f"{path}: this data set has one kind of ground truth; figure 4.11 needs the synthetic world")
    return frame.semi_dense


def image_of(recipe: Recipe, frame: StoredFrame) -> NDArray[np.uint8]:
    """The image, black where the recipe has no colour (in training and test alike)."""
    return frame.image if recipe.settings["colour"] else np.zeros_like(frame.image)


def sparse_of(recipe: Recipe, frame: StoredFrame, path: Path) -> NDArray[np.float32]:
    """The sparse map with the recipe's rows; empty for 0. UsageError when the data has no points to thin."""
    rows = int(recipe.settings["rows"])
    if rows == 0:
        return np.zeros_like(frame.clean)
    if rows not in frame.sparse:
        raise UsageError(f"{path}: fewer LiDAR rows need the data set's point clouds, which it does not have")
    return frame.sparse[rows]


def random_samples(depth: NDArray[np.float32], rng: np.random.Generator, count: int = SAMPLES) -> NDArray[np.float32]:
    """`count` valid pixels of a depth map, 0 elsewhere."""
    valid = np.flatnonzero(depth > 0)
    chosen = rng.choice(valid, min(count, len(valid)), replace=False)
    sparse = np.zeros_like(depth)
    sparse.ravel()[chosen] = depth.ravel()[chosen]
    return sparse


def test_frame(recipe: Recipe, path: Path) -> StoredFrame:
    """A test frame whose 64-row map and image are what the recipe's network sees."""
    frame = _load(path)
    if recipe.settings["target"] == "clean":
        frame = replace(frame, semi_dense=None)  # so that a run's numbers do not depend on what else was made
    sparse = sparse_of(recipe, frame, path)
    if recipe.settings["scene"] == "samples_500":
        seed = int.from_bytes(path.stem.encode()[-6:], "big")
        sparse = random_samples(frame.clean, np.random.default_rng(seed))
    return replace(frame, image=image_of(recipe, frame), sparse={64: sparse})
