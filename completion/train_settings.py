"""The settings of a training run, and the schedules they describe."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import ClassVar

import torch

from auglidar_base.devices import check_device
from auglidar_base.errors import SettingsError
from completion.models import ModelSpec
from completion.samples import Augmentation
from completion.training_loss import LossSettings, fits

_LATER = (
    ("loss", "clamp_depth", 0),
    ("augmentation", "top", 0),
    ("augmentation", "rotate", 0),
    ("augmentation", "scale", 1),
)
PRECISIONS = {"fp32": None, "bf16": torch.bfloat16, "fp16": torch.float16}


@dataclass(frozen=True)
class TrainSettings:
    """One training run. Defaults: the thesis (sections 4.4, 4.5): Adam at 1e-3 halved every 5 epochs, whole frames,
    gradients of 4 samples, scales (1, 1, 1) for 10 epochs, (1, 0.1, 0.1) for 10, then (1, 0, 0).

    model            network and input scaling
    loss             what training minimises
    augmentation     disturbances of the samples
    steps            updates of the weights in all, over which the schedules run; None: `epochs`
    batch_size       samples of one backward pass, per process; `accumulate` passes make an update
    learning_rate    largest of the schedule
    save_every       steps between saved states and last checkpoints
    validate_every   steps between validations; 0: only at the end
    device           "auto", "cpu", "cuda", "cuda:N" or "mps"
    seed             of everything random
    warm_start       weights (a path or a bundled name) to begin with: of the same network, of a narrower one, or of
                     another architecture with layers in common (its head stays as built)
    epochs           unit of the schedules, and the length of the run without `steps`; a fraction is allowed
    steps_per_epoch  updates of an epoch; None: one pass over the samples
    max_steps        end earlier; None: do not (the schedules keep their length)
    accumulate       backward passes of one update
    crops_per_frame  crops taken from each frame read; must divide batch_size x accumulate
    schedule         "halving" (learning rate x 0.5 every `halve_every` epochs), "cosine" (to 0 at the end) or
                     "staircase" (`rate_factors`)
    halve_every      epochs
    rate_factors     (from epoch, factor of the learning rate), ascending, the first from 0
    warmup_steps     learning rate rises linearly over these first steps
    clip_gradient    largest norm of an update's gradient; 0: none
    weight_decay     of Adam
    scale_weights    (from epoch, weights of the outputs, finest first), ascending
    precision        "fp32", or "bf16" / "fp16" autocast on a GPU
    decoding         how validation reads one depth from the output; "" for the usual one
    validation_frames  frames of a validation, at most
    best_by          the validation figure that chooses the best checkpoint, lower is better
    log_every        steps between rows of log.csv
    save_seconds     the state is saved after so many seconds too
    workers          processes that prepare batches; 0: this one
    """

    RENAMED: ClassVar[Mapping[str, str]] = {
        "batch": "batch_size",
        "checkpoint_steps": "save_every",
        "checkpoint_seconds": "save_seconds",
        "objective": "loss",
        "read_out": "decoding",
    }

    model: ModelSpec
    loss: LossSettings = field(default_factory=LossSettings)
    augmentation: Augmentation = field(default_factory=Augmentation)
    steps: int | None = None
    batch_size: int = 1
    learning_rate: float = 1e-3
    save_every: int = 1000
    validate_every: int = 0
    device: str = "cpu"
    seed: int = 0
    warm_start: str | None = None
    epochs: float = 30
    steps_per_epoch: int | None = None
    max_steps: int | None = None
    accumulate: int = 4
    crops_per_frame: int = 1
    schedule: str = "halving"
    halve_every: float = 5
    rate_factors: tuple[tuple[float, float], ...] = ((0, 1.0),)
    warmup_steps: int = 0
    clip_gradient: float = 0.0
    weight_decay: float = 0.0
    scale_weights: tuple[tuple[float, tuple[float, ...]], ...] = ((0, (1, 1, 1)), (10, (1, 0.1, 0.1)), (20, (1, 0, 0)))
    precision: str = "fp32"
    decoding: str = ""
    validation_frames: int = 8
    best_by: str = "mae_mm"
    log_every: int = 50
    save_seconds: float = 300.0
    workers: int = 0

    def __post_init__(self) -> None:
        fits(self.loss, self.model)
        if self.schedule not in ("halving", "cosine", "staircase"):
            raise SettingsError(f"schedule: expected 'halving', 'cosine' or 'staircase', got {self.schedule!r}")
        starts = [start for start, _ in self.rate_factors]
        if not starts or starts[0] != 0 or starts != sorted(starts):
            raise SettingsError(f"rate_factors: expected pairs (from epoch, factor) ascending from 0, got {starts}")
        if self.precision not in PRECISIONS:
            raise SettingsError(f"precision: expected one of {', '.join(PRECISIONS)}, got {self.precision!r}")
        check_device(self.device)
        if self.precision != "fp32" and self.device in ("cpu", "mps"):
            raise SettingsError(f"precision {self.precision!r} is for a GPU; on {self.device!r} use 'fp32'")
        for name in ("epochs", "steps", "batch_size", "accumulate", "crops_per_frame", "log_every", "save_every"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise SettingsError(f"{name}: expected a value > 0, got {value}")

    @property
    def identity(self) -> str:
        """Hash of everything that determines the weights; a run resumes only under the same one."""
        what = asdict(self)
        for free in ("max_steps", "validate_every", "validation_frames", "log_every", "save_every", "device"):
            del what[free]
        for free in ("save_seconds", "workers", "best_by", "decoding"):
            del what[free]
        # Later settings, left out where they change nothing, so that earlier runs go on.
        later = {"warm_start": None, "rate_factors": ((0, 1.0),)}
        for name in [name for name, idle in later.items() if what[name] == idle]:
            del what[name]
        for section, name, idle in _LATER:
            if what[section][name] == idle:
                del what[section][name]
        return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()


def learning_rate(settings: TrainSettings, step: int, steps_per_epoch: int, total: int) -> float:
    """Learning rate of optimiser step `step` (from 0)."""
    rate = settings.learning_rate
    if settings.schedule == "halving":
        rate *= 0.5 ** int(step / steps_per_epoch / settings.halve_every)
    elif settings.schedule == "staircase":
        rate *= [factor for start, factor in settings.rate_factors if start <= step / steps_per_epoch][-1]
    else:
        rate *= 0.5 * (1 + torch.cos(torch.tensor(torch.pi * step / total, dtype=torch.float64)).item())
    return rate * min(1.0, (step + 1) / (settings.warmup_steps + 1))


def scales_at(settings: TrainSettings, epoch: float) -> tuple[float, ...]:
    """Weights of the outputs at this epoch (from 0)."""
    return [weights for start, weights in settings.scale_weights if start <= epoch][-1]
