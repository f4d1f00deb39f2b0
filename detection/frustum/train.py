"""Training Frustum PointNet v1 on labelled frames: by steps, resumable to the bit.

Everything random derives from (seed, purpose, step), so a run that was killed continues as if it had not been.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from auglidar_base.devices import check_device, resolve_device
from auglidar_base.errors import CheckpointError, SettingsError
from auglidar_base.progress import Pace, TrainProgress
from auglidar_base.seeding import derived_seed, torch_seeded
from detection.checkpoints import load_tensors, save_tensors
from detection.frustum.checkpoints import load_frustum_checkpoint, save_frustum_checkpoint
from detection.frustum.coding import CLASSES
from detection.frustum.losses import frustum_losses
from detection.frustum.network import VARIANTS, FrustumPointNet
from detection.frustum.samples import SHIFTS, FrustumBatch, FrustumSample, augmented, collate, frame_samples, thinned
from detection.frustum.validation import frustum_figures
from detection.models.layers import set_batchnorm_momentum
from detection.training_batches import LabelledFrames
from detection.training_log import TrainingLog

FORMAT = "auglidar-frustum-run-1"
_ORDER, _FRUSTUMS, _BATCH, _STEP = 1, 2, 3, 4


@dataclass(frozen=True)
class FrustumTrainSettings:
    """One training run; the numbers are those of the published training where it says any.

    steps            updates of the weights in all       batch_size  frustums of one, at least 2
    learning_rate    of Adam, halved after every `decay_samples` frustums
    save_every       steps between saved states and last checkpoints
    validate_every   steps between validations; 0: only at the end
    device, seed     as in `detection.train_settings.TrainSettings`
    warm_start       weights of Frustum PointNet to begin with, or None
    variant, channels  of the network
    classes          whose labels are trained on
    points           drawn from a frustum for the network       kept_points  held in memory of each, at most
    copies           of every labelled box, moved at random
    depth_shift      "intended", "original" or "none", see `detection.frustum.samples.depth_shift`
    log_every        steps between rows of log.csv
    """

    steps: int = 150_000
    batch_size: int = 32
    learning_rate: float = 0.001
    save_every: int = 500
    validate_every: int = 0
    device: str = "cpu"
    seed: int = 0
    warm_start: str | None = None
    variant: str = "tf"
    channels: int = 4
    classes: tuple[str, ...] = CLASSES
    points: int = 1024
    kept_points: int = 4096
    copies: int = 5
    depth_shift: str = "intended"
    decay_samples: int = 800_000
    log_every: int = 20

    def __post_init__(self) -> None:
        check_device(self.device)
        for name in ("steps", "learning_rate", "save_every", "points", "kept_points", "copies", "log_every"):
            if not getattr(self, name) > 0:
                raise SettingsError(f"{name}: expected a value > 0, got {getattr(self, name)}")
        if self.batch_size < 2:
            raise SettingsError(f"batch_size: expected at least 2 (batch normalisation), got {self.batch_size}")
        for name, known in (("variant", VARIANTS), ("depth_shift", SHIFTS)):
            if getattr(self, name) not in known:
                raise SettingsError(f"{name}: expected one of {', '.join(known)}, got {getattr(self, name)!r}")
        if not self.classes or set(self.classes) - set(CLASSES):
            raise SettingsError(f"classes: expected some of {', '.join(CLASSES)}, got {', '.join(self.classes)}")

    def identity(self) -> str:
        """JSON of everything that determines the weights; a run resumes only under the same one."""
        values = dataclasses.asdict(self)
        for free in ("save_every", "validate_every", "log_every", "device"):
            del values[free]
        return json.dumps(values, sort_keys=True)


def learning_rate(step: int, settings: FrustumTrainSettings) -> float:
    """Of a 0-based step: halved after every `decay_samples` frustums."""
    return settings.learning_rate * 0.5 ** (step * settings.batch_size // settings.decay_samples)


def norm_momentum(step: int, settings: FrustumTrainSettings) -> float:
    """Of the batch normalisation at a 0-based step: 0.5, halved like the learning rate, at least 0.01."""
    return max(0.01, 0.5 * 0.5 ** (step * settings.batch_size // settings.decay_samples))


@lru_cache(maxsize=2)
def _permutation(seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    return np.random.default_rng([seed, _ORDER, epoch]).permutation(count)


def gathered(frames: LabelledFrames, settings: FrustumTrainSettings, moved: bool = True) -> list[FrustumSample]:
    """The frustums of all frames in order; `moved`: copies with moved boxes, otherwise each label's own."""
    found: list[FrustumSample] = []
    for index in range(len(frames)):
        rng = np.random.default_rng([settings.seed, _FRUSTUMS, index])
        frame, labels = frames[index]
        made = frame_samples(
            frame, labels, settings.channels, rng if moved else None, settings.copies, settings.classes
        )
        found += [thinned(sample, settings.kept_points, rng) for sample in made]
    return found


class FrustumTrainer:
    """The state of a run and its one step."""

    def __init__(self, settings: FrustumTrainSettings, samples: Sequence[FrustumSample]) -> None:
        if not samples:
            kinds = ", ".join(settings.classes)
            raise SettingsError(
                f"training: no frustum of {kinds} with a box of 25 px or more and a point of the object in any frame"
            )
        self.settings, self.samples = settings, samples
        self.device = resolve_device(settings.device)
        self.model = _first_model(settings).to(self.device)
        self.adam = torch.optim.Adam(self.model.parameters(), lr=settings.learning_rate)
        self.pace = Pace(0, 0.0, time.monotonic())

    def batch(self, step: int) -> FrustumBatch:
        """The frustums of a step: consecutive places of a permutation drawn anew for every epoch."""
        settings, count = self.settings, len(self.samples)
        rng = np.random.default_rng([settings.seed, _BATCH, step])
        chosen = []
        for place in range(step * settings.batch_size, (step + 1) * settings.batch_size):
            epoch, within = divmod(place, count)
            chosen.append(self.samples[int(_permutation(settings.seed, epoch, count)[within])])
        moved = [augmented(sample, settings.depth_shift, rng) for sample in chosen]
        return collate(moved, settings.points, rng, self.device)

    def step(self, step: int) -> dict[str, float]:
        """One update; returns the losses."""
        batch = self.batch(step)
        self.model.train()
        set_batchnorm_momentum(self.model, norm_momentum(step, self.settings))
        for group in self.adam.param_groups:
            group["lr"] = learning_rate(step, self.settings)
        with torch_seeded(derived_seed(self.settings.seed, _STEP, step), self.device):
            output = self.model(batch.points, batch.one_hot, np.random.default_rng([self.settings.seed, _STEP, step]))
            losses = frustum_losses(output, batch.targets, self.settings.variant)
            if not bool(torch.isfinite(losses["loss"])):
                raise SettingsError(f"training: the loss is not finite at step {step + 1}; lower learning_rate")
            losses["loss"].backward()
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)
        return {name: float(value.detach()) for name, value in losses.items()}

    def checkpoint(self, path: Path, done: int, facts: dict[str, Any] | None = None) -> Path:
        """Weights after `done` steps with their card."""
        described = {
            "steps": done,
            "seed": self.settings.seed,
            "frustums": len(self.samples),
            "hours": round(self.pace.spent(time.monotonic()) / 3600, 3),
            "training": json.loads(self.settings.identity()),
            "versions": {"torch": torch.__version__, "numpy": np.__version__},
        }
        return save_frustum_checkpoint(self.model, path, described | (facts or {}))

    def save(self, folder: Path, done: int) -> None:
        """The last checkpoint, then the complete state after `done` steps, each atomically."""
        self.checkpoint(folder / "last.safetensors", done)
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        for name, parameter in self.model.named_parameters():
            tensors |= {f"adam.{key}.{name}": value for key, value in self.adam.state[parameter].items()}
        seconds = f"{self.pace.spent(time.monotonic()):.1f}"
        facts = {"format": FORMAT, "done": str(done), "seconds": seconds, "settings": self.settings.identity()}
        save_tensors(folder / "state.safetensors", tensors, facts)

    def resume(self, folder: Path) -> int:
        """Load the state if there is one; returns the steps done.

        Raises SettingsError for the state of another run, CheckpointError for a file that is no such state.
        """
        path = folder / "state.safetensors"
        if not path.is_file():
            return 0
        tensors, metadata = load_tensors(path)
        if metadata.get("format") != FORMAT:
            raise CheckpointError(f"{path}: expected the state of a Frustum PointNet training ({FORMAT})")
        if metadata["settings"] != self.settings.identity():
            raise SettingsError(
                f"{path}: the state of a run with other settings; use another output folder or remove it"
            )
        self.model.load_state_dict({n[len("model.") :]: v for n, v in tensors.items() if n.startswith("model.")})
        for name, parameter in self.model.named_parameters():
            self.adam.state[parameter] = _moments(tensors, name, self.device)
        done = int(metadata["done"])
        self.pace = Pace(done, float(metadata["seconds"]), time.monotonic())
        return done


def _moments(tensors: dict[str, Tensor], name: str, device: torch.device) -> dict[str, Tensor]:
    """Adam's memory of a parameter; its counter stays on the CPU."""
    found = {key: tensors[f"adam.{key}.{name}"] for key in ("step", "exp_avg", "exp_avg_sq")}
    return {key: value if key == "step" else value.to(device) for key, value in found.items()}


def _first_model(settings: FrustumTrainSettings) -> FrustumPointNet:
    """The network before the first step, on the CPU."""
    if settings.warm_start is not None:
        model = load_frustum_checkpoint(settings.warm_start)
        if (model.variant, model.channels) != (settings.variant, settings.channels):
            raise SettingsError(
                f"warm_start: {settings.warm_start} is variant {model.variant} with {model.channels} channels, the "
                f"settings ask for {settings.variant} with {settings.channels}"
            )
        return model
    with torch_seeded(settings.seed, torch.device("cpu")):
        return FrustumPointNet(settings.variant, settings.channels)


def train_frustums(
    settings: FrustumTrainSettings,
    frames: LabelledFrames,
    out: str | Path,
    validation: LabelledFrames | None = None,
    progress: Callable[[TrainProgress], None] | None = None,
) -> Path:
    """Train, or continue the run in `out`; returns the last checkpoint (.safetensors with its card).

    `out` also receives state.safetensors (for resuming), log.csv and validation.csv.

    frames, validation  len() and frames[i] -> (PointFrame, list of KittiObject); the points give the frustums
    Raises SettingsError for frames without a usable object, a state of other settings, or a loss that is not finite.
    """
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    trainer = FrustumTrainer(settings, gathered(frames, settings))
    held_out = gathered(validation, settings, moved=False) if validation is not None else []
    done = trainer.resume(folder)
    log, checks = TrainingLog(folder, done), TrainingLog(folder, done, "validation.csv")
    since: list[dict[str, float]] = []
    for number in range(done + 1, settings.steps + 1):
        since.append(trainer.step(number - 1))
        finished = number == settings.steps
        if finished or number % settings.log_every == 0:
            means = {name: float(np.mean([losses[name] for losses in since])) for name in since[0]}
            log.write(number, means)
            since = []
            if progress is not None:
                progress(trainer.pace.progress(number, settings.steps, means, time.monotonic()))
        if held_out and (finished or (settings.validate_every and number % settings.validate_every == 0)):
            checks.write(number, frustum_figures(trainer.model, held_out, settings.points, trainer.device))
        if finished or number % settings.save_every == 0:
            trainer.save(folder, number)
    return folder / "last.safetensors"
