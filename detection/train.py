"""Training a detector on frames with labels: by steps, resumable to the bit, in one or several processes.

Everything random at a step derives from (seed, purpose, step, rank), so a run that was killed continues exactly as if
it had not been, and the caller's generators stay as they are. Several processes (torchrun, or `train_in_processes`)
average their gradients after each backward pass.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn

from auglidar_base.children import end_with_parent
from auglidar_base.devices import resolve_device
from auglidar_base.errors import CheckpointError, SettingsError
from auglidar_base.progress import Pace, TrainProgress
from auglidar_base.seeding import derived_seed, torch_seeded
from auglidar_base.versions import own_version, state_of_another_version
from detection.checkpoints import load_checkpoint, load_tensors, save_checkpoint, save_tensors
from detection.models.added_classes import with_classes
from detection.models.batch import DetectorModel, PointBatch
from detection.models.layers import set_batchnorm_momentum
from detection.models.presets import PRESETS, Preset
from detection.models.warm_start import copy_matching
from detection.optimiser import AdamOneCycle, batchnorm_momentum
from detection.train_settings import TrainSettings
from detection.training_batches import (
    SAMPLES,
    LabelledFrames,
    Scenes,
    collate,
    frame_order,
    object_database,
    prepare_sample,
)
from detection.training_log import TrainingLog
from detection.validation import validation_figures

__all__ = ["LabelledFrames", "TrainProgress", "TrainSettings", "Trainer", "train", "train_in_processes"]

FORMAT = "auglidar-detection-run-2"  # states of the first version have no format
# What torch's random numbers are for, beside the purposes in `training_batches`.
_STEP, _VALIDATION = 4, 5


@dataclass(frozen=True)
class _Workers:
    """This process among those of the run."""

    rank: int
    count: int

    @classmethod
    def current(cls, device: torch.device) -> _Workers:
        """From torchrun's environment; alone without it."""
        if "RANK" in os.environ and "WORLD_SIZE" in os.environ and not dist.is_initialized():
            dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
        if dist.is_initialized():
            return cls(dist.get_rank(), dist.get_world_size())
        return cls(0, 1)

    def average(self, tensors: list[Tensor]) -> None:
        """Replace each tensor by its mean over all processes, in one message."""
        if self.count == 1 or not tensors:
            return
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        dist.all_reduce(flat)
        flat /= self.count
        for tensor, part in zip(tensors, flat.split([tensor.numel() for tensor in tensors])):
            tensor.copy_(part.view_as(tensor))


def _preset(settings: TrainSettings) -> Preset:
    """The detector asked for. SettingsError for an unknown name or options that it does not take."""
    if settings.preset not in PRESETS:
        raise SettingsError(f"preset: expected one of {', '.join(PRESETS)}, got {settings.preset!r}")
    try:
        inspect.signature(PRESETS[settings.preset]).bind(**settings.options)
    except TypeError as error:
        raise SettingsError(f"options of preset {settings.preset}: {error}") from None
    return PRESETS[settings.preset](**settings.options)


def _first_model(settings: TrainSettings, preset: Preset) -> nn.Module:
    """The network before the first step, on the CPU."""
    with torch_seeded(settings.seed, torch.device("cpu")):
        model = preset.build()
        if not hasattr(model, "training_losses"):
            raise SettingsError(f"preset {settings.preset}: its network can be imported and run, but not trained")
        if settings.warm_start is not None:
            start = load_checkpoint(settings.warm_start)[0]
            copy_matching(with_classes(start, preset.classes), model)
    return model


class Trainer:
    """The state of a run and its one step."""

    def __init__(self, settings: TrainSettings, samples: LabelledFrames) -> None:
        if len(samples) == 0:
            raise SettingsError("training: expected at least one frame, got an empty data source")
        self.settings, self.device = settings, resolve_device(settings.device)
        self.workers = _Workers.current(self.device)
        self.preset = _preset(settings)
        self.model = _first_model(settings, self.preset).to(self.device)
        self.optimiser = AdamOneCycle(self.model, settings.steps, settings.learning_rate, settings.optimiser)
        self.scenes = Scenes(samples, self.preset, settings.cache_mb)
        self.database = object_database(samples, self.preset, settings)
        self.epoch_steps = max(1, len(samples) // (settings.batch_size * self.workers.count))
        self.best = -1.0
        self.pace = Pace(0, 0.0, time.monotonic())

    def batch(self, step: int) -> PointBatch:
        """The frames of a step, prepared with the step's own random numbers."""
        rng = np.random.default_rng([self.settings.seed, SAMPLES, step, self.workers.rank])
        order = frame_order(step, len(self.scenes.samples), self.settings, self.workers.rank, self.workers.count)
        prepared = [
            prepare_sample(self.scenes[index], self.preset, self.settings, self.database, rng) for index in order
        ]
        return collate(prepared, self.device)

    def step(self, step: int) -> dict[str, float]:
        """One update; returns the losses and the norm of the gradient."""
        batch = self.batch(step)
        purpose = (self.settings.seed, _STEP, step, self.workers.rank)
        rng = np.random.default_rng(np.random.SeedSequence(purpose).spawn(1)[0])
        self.model.train()
        if self.preset.norm_schedule:
            set_batchnorm_momentum(self.model, batchnorm_momentum(step, self.epoch_steps))
        with torch_seeded(derived_seed(*purpose), self.device):
            losses = cast(DetectorModel, self.model).training_losses(batch, rng)
            if not bool(torch.isfinite(losses["loss"])):
                raise SettingsError(f"training: the loss is not finite at step {step + 1}; lower learning_rate")
            losses["loss"].backward()
        gradients = [parameter.grad for parameter in self.optimiser.parameters if parameter.grad is not None]
        self.workers.average(gradients)
        norm = self.optimiser.step(step)
        # Running statistics too, so that every process holds the same network.
        self.workers.average([buffer for buffer in self.model.buffers() if buffer.is_floating_point()])
        return {**{name: float(value.detach()) for name, value in losses.items()}, "gradient_norm": norm}

    def validate(self, folder: Path, done: int, validation: LabelledFrames) -> dict[str, float]:
        """Average precision on the validation frames; the best checkpoint is kept."""
        with torch_seeded(derived_seed(self.settings.seed, _VALIDATION), self.device):
            figures = validation_figures(self.model, self.preset, self.device, validation, self.settings)
        if self.settings.best_by not in figures:
            raise SettingsError(f"best_by: expected one of {', '.join(figures)}, got {self.settings.best_by!r}")
        # Of equal ones the later: a network that finds nothing yet learns on.
        if figures[self.settings.best_by] >= self.best:
            self.best = figures[self.settings.best_by]
            self.checkpoint(folder / "best.safetensors", done, {"validation": figures})
        return figures

    def checkpoint(self, path: Path, done: int, facts: dict[str, Any] | None = None) -> Path:
        """Weights after `done` steps with their card."""
        described = {
            "steps": done,
            "seed": self.settings.seed,
            "frames": len(self.scenes.samples),
            "hours": round(self.pace.spent(time.monotonic()) / 3600, 3),
            "training": json.loads(self.settings.identity(self.workers.count)),
            "versions": {"torch": torch.__version__, "numpy": np.__version__},
        }
        return save_checkpoint(self.model, self.preset, path, described | (facts or {}))

    def save(self, folder: Path, done: int) -> None:
        """The last checkpoint, then the complete state after `done` steps, each atomically."""
        self.checkpoint(folder / "last.safetensors", done)
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= {f"adam.{name}": value for name, value in self.optimiser.state_tensors().items()}
        facts = {
            "format": FORMAT,
            "version": own_version(),
            "done": str(done),
            "best": repr(self.best),
            "seconds": f"{self.pace.spent(time.monotonic()):.1f}",
            "settings": self.settings.identity(self.workers.count),
        }
        save_tensors(folder / "state.safetensors", tensors, facts)

    def resume(self, folder: Path) -> int:
        """Load the state if there is one; returns the steps done.

        Raises SettingsError for the state of another run, CheckpointError for one of an earlier version.
        """
        path = folder / "state.safetensors"
        if not path.is_file():
            return 0
        tensors, metadata = load_tensors(path)
        if "done" not in metadata:
            raise CheckpointError(f"{path}: expected the state of a training run ({FORMAT}), got other tensors")
        if metadata.get("format") != FORMAT:
            raise state_of_another_version(path, metadata.get("format", "1"), FORMAT, metadata.get("version"))
        if metadata["settings"] != self.settings.identity(self.workers.count):
            raise SettingsError(
                f"{path}: the state of a run with other settings; use another output folder or remove it"
            )

        def under(prefix: str) -> dict[str, Tensor]:
            return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}

        self.model.load_state_dict(under("model."))
        self.optimiser.load_state_tensors(under("adam."))
        self.best, done = float(metadata["best"]), int(metadata["done"])
        self.pace = Pace(done, float(metadata["seconds"]), time.monotonic())
        return done


class _Log:
    """log.csv and validation.csv of the first process; losses are means since the last row."""

    def __init__(self, folder: Path, done: int) -> None:
        self.losses = TrainingLog(folder, done, "log.csv")
        self.validation = TrainingLog(folder, done, "validation.csv")
        self.sums: dict[str, float] = {}
        self.count = 0

    def add(self, losses: dict[str, float]) -> None:
        """The losses of a step."""
        self.count += 1
        for name, value in losses.items():
            self.sums[name] = self.sums.get(name, 0.0) + value

    def write(self, step: int) -> dict[str, float]:
        """A row; returns its means."""
        means = {name: value / self.count for name, value in self.sums.items()}
        self.losses.write(step, means)
        self.sums, self.count = {}, 0
        return means


def train(
    settings: TrainSettings,
    samples: LabelledFrames,
    out: str | Path,
    validation: LabelledFrames | None = None,
    progress: Callable[[TrainProgress], None] | None = None,
) -> Path:
    """Train, or continue the run in `out`, and return the best checkpoint (the last one without validation frames).

    `out` receives state.safetensors (for resuming), last and best .safetensors with cards, log.csv, validation.csv and,
    when TensorBoard is installed, its events.

    samples     len() and samples[i] -> (PointFrame, list of KittiObject)
    validation  other frames of that kind, or None
    progress    called with every row of log.csv, in the first process

    Under torchrun every process calls this with the same arguments; rank 0 writes. The caller's random generators stay
    as they are. Raises SettingsError for an empty source, a state of other settings, or a loss that is not finite.
    """
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(settings, samples)
    done = trainer.resume(folder)
    log = _Log(folder, done) if trainer.workers.rank == 0 else None
    for step in range(done, settings.steps):
        losses = trainer.step(step)
        if log is None:
            continue
        log.add(losses)
        number = step + 1
        finished = number == settings.steps
        if finished or number % settings.log_every == 0:
            told = trainer.pace.progress(number, settings.steps, log.write(number), time.monotonic())
            if progress is not None:
                progress(told)
        if validation is not None and len(validation) and (finished or _is_due(number, settings.validate_every)):
            log.validation.write(number, trainer.validate(folder, number, validation))
        if finished or number % settings.save_every == 0:
            trainer.save(folder, number)
    if log is not None and done >= settings.steps:
        trainer.checkpoint(folder / "last.safetensors", done)
    if trainer.workers.count > 1:
        dist.barrier()  # the first process has written the files that every one returns
    return _best(folder)


def _is_due(step: int, every: int) -> bool:
    return every > 0 and step % every == 0


def _best(folder: Path) -> Path:
    """The best checkpoint of a run, or the last where nothing was validated."""
    best = folder / "best.safetensors"
    return best if best.is_file() else folder / "last.safetensors"


def _train_worker(rank: int, count: int, port: int, arguments: tuple[Any, ...]) -> None:
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(count), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    torch.set_num_threads(1)
    settings, samples, out, validation, progress = arguments
    end_with_parent()
    try:
        train(settings, samples, out, validation, progress)
    finally:
        if dist.is_initialized():
            dist.destroy_process_group()


def train_in_processes(
    settings: TrainSettings,
    samples: LabelledFrames,
    out: str | Path,
    processes: int,
    validation: LabelledFrames | None = None,
    progress: Callable[[TrainProgress], None] | None = None,
) -> Path:
    """`train` on the CPU in several one-thread processes with averaged gradients (2 such beat one with two threads).

    samples, validation and progress are sent to the processes and must be picklable; progress is called in the first.
    settings.batch_size counts per process.
    """
    import socket

    settings = dataclasses.replace(settings, device="cpu")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    torch.multiprocessing.spawn(
        _train_worker, args=(processes, port, (settings, samples, out, validation, progress)), nprocs=processes
    )
    return _best(Path(out))
