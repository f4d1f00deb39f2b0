"""Training of every network of this library by one plain loop.

A loop of one's own rather than a training framework: resume has to be exact to the bit after SIGKILL, and the whole of
it, data order included, has to be readable on one screen. Distribution is torchrun's: start the same command with
`torchrun --nproc-per-node N`, each process takes its part of every step.
"""

from __future__ import annotations

import csv
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from auglidar_base.children import loader_worker
from completion.checkpoints import Card, load_checkpoint, save_checkpoint
from completion.decoding import default_decoding
from completion.diagnostics import diagnose
from completion.growth import adopt, grow
from completion.infer import NetworkCompleter, network_completer
from completion.inputs import scale_rgb
from completion.models import ModelSpec, build_model
from completion.resume import load_state, save_state
from completion.samples import Augmentation, Batch, SampleSource, StepBatches
from completion.training_loss import LossSettings, fits, training_loss
from completion.types import DepthFrame

PRECISIONS = {"fp32": None, "bf16": torch.bfloat16, "fp16": torch.float16}


@dataclass(frozen=True)
class TrainSettings:
    """One training run. Defaults: the thesis (sections 4.4, 4.5): Adam at 1e-3 halved every 5 epochs, whole frames,
    gradients of 4 samples, scales (1, 1, 1) for 10 epochs, (1, 0.1, 0.1) for 10, then (1, 0, 0).

    model            network and input scaling
    epochs           length of the run and unit of the schedules; a fraction is allowed
    steps_per_epoch  optimiser steps of an epoch; None: one pass over the samples
    max_steps        end earlier than `epochs`; None: do not (the schedules keep their length)
    batch            crops of one backward pass, per process; `accumulate` passes make a step
    crops_per_frame  crops taken from each frame read; must divide batch x accumulate
    schedule         "halving" (learning rate x 0.5 every `halve_every` epochs) or "cosine" (to 0 at the end)
    warmup_steps     learning rate rises linearly over these first steps
    clip_gradient    largest norm of a step's gradient; 0: none
    scale_weights    (from epoch, weights of the outputs, finest first), ascending
    precision        "fp32", or "bf16" / "fp16" autocast on a GPU
    decoding         how validation reads one depth from the output; "" for the usual one
    warm_start       weights (a path or a bundled name) to begin with: of the same network, of a narrower one, or of
                     another architecture with layers in common (its head stays as built)
    validate_every   steps between validations; 0: only at the end
    best_by          the validation figure that chooses the best checkpoint, lower is better
    log_every        steps between rows of log.csv
    checkpoint_steps, checkpoint_seconds   save the state after so many steps, or so much time
    workers          processes that prepare batches; 0: this one
    """

    model: ModelSpec
    loss: LossSettings = field(default_factory=LossSettings)
    augmentation: Augmentation = field(default_factory=Augmentation)
    seed: int = 0
    epochs: float = 30
    steps_per_epoch: int | None = None
    max_steps: int | None = None
    batch: int = 1
    accumulate: int = 4
    crops_per_frame: int = 1
    learning_rate: float = 1e-3
    weight_decay: float = 0.0
    schedule: str = "halving"
    halve_every: float = 5
    warmup_steps: int = 0
    clip_gradient: float = 0.0
    scale_weights: tuple[tuple[float, tuple[float, ...]], ...] = ((0, (1, 1, 1)), (10, (1, 0.1, 0.1)), (20, (1, 0, 0)))
    precision: str = "fp32"
    decoding: str = ""
    warm_start: str | None = None
    validate_every: int = 0
    validation_frames: int = 8
    best_by: str = "mae_mm"
    log_every: int = 50
    checkpoint_steps: int = 1000
    checkpoint_seconds: float = 300.0
    workers: int = 0
    device: str = "cpu"

    def __post_init__(self) -> None:
        fits(self.loss, self.model)
        if self.schedule not in ("halving", "cosine"):
            raise ValueError(f"schedule: expected 'halving' or 'cosine', got {self.schedule!r}")
        if self.precision not in PRECISIONS:
            raise ValueError(f"precision: expected one of {', '.join(PRECISIONS)}, got {self.precision!r}")
        if self.precision != "fp32" and not self.device.startswith("cuda"):
            raise ValueError(f"precision {self.precision!r} is for a GPU; on {self.device!r} use 'fp32'")
        for name in ("epochs", "batch", "accumulate", "crops_per_frame", "log_every", "checkpoint_steps"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a value > 0, got {getattr(self, name)}")

    @property
    def identity(self) -> str:
        """Hash of everything that determines the weights; a run resumes only under the same one."""
        what = asdict(self)
        for free in ("max_steps", "validate_every", "validation_frames", "log_every", "checkpoint_steps"):
            del what[free]
        for free in ("checkpoint_seconds", "workers", "best_by", "decoding"):
            del what[free]
        if self.warm_start is None:
            del what["warm_start"]
        return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class TrainProgress:
    """What a progress callback is told: step (1-based) of steps, mean losses since the last call, seconds per step
    since the run was started or continued, and the seconds that remain."""

    step: int
    steps: int
    losses: dict[str, float]
    seconds_per_step: float
    eta_seconds: float

    @classmethod
    def after(cls, seconds: float, done: int, step: int, steps: int, losses: dict[str, float]) -> TrainProgress:
        """At `step`, when `done` steps took so many seconds."""
        pace = seconds / done
        return cls(step, steps, losses, pace, pace * (steps - step))


def learning_rate(settings: TrainSettings, step: int, steps_per_epoch: int, total: int) -> float:
    """Learning rate of optimiser step `step` (from 0)."""
    rate = settings.learning_rate
    if settings.schedule == "halving":
        rate *= 0.5 ** int(step / steps_per_epoch / settings.halve_every)
    else:
        rate *= 0.5 * (1 + torch.cos(torch.tensor(torch.pi * step / total, dtype=torch.float64)).item())
    return rate * min(1.0, (step + 1) / (settings.warmup_steps + 1))


def scales_at(settings: TrainSettings, epoch: float) -> tuple[float, ...]:
    """Weights of the outputs at this epoch (from 0)."""
    return [weights for start, weights in settings.scale_weights if start <= epoch][-1]


def train(
    settings: TrainSettings,
    samples: SampleSource,
    out: str | Path,
    validation: Sequence[DepthFrame] = (),
    facts: dict[str, Any] | None = None,
    seconds: float | None = None,
    progress: Callable[[TrainProgress], None] | None = None,
) -> Path:
    """Train, or continue the run in `out`, and return the best checkpoint (the last one without validation frames).

    `out` receives state.safetensors (for resuming), last and best .safetensors with cards, log.csv, validation.csv and,
    when TensorBoard is installed, its events.

    samples     `samples[i]` is a DepthFrame with target, or a TrainingSample
    validation  frames with target; the diagnostics of each validation are logged
    facts       goes into the cards: data, command, ...
    seconds     stop after about this much time, with the state saved; call again to go on
    progress    called with every row of log.csv, in the first process

    Raises ValueError when settings, samples and the run in `out` do not fit together.
    """
    rank, processes = _join_processes(settings.device)
    run = _Run(settings, samples, Path(out), rank, processes)
    step, last_saved = run.step, run.begun
    for batches in run.batches(step):
        run.optimise(step, batches)
        step += 1
        now = time.monotonic()
        finished = step == run.total or _agreed(seconds is not None and now - run.begun > seconds, processes)
        validate = bool(settings.validate_every) and step % settings.validate_every == 0
        if step % settings.log_every == 0 or finished:
            losses = run.log(step)
            if progress is not None and rank == 0:
                progress(TrainProgress.after(now - run.begun, step - run.begun_at, step, run.total, losses))
        if len(validation) and (validate or step == run.total):
            run.validate(step, validation, facts or {})
        if finished or step % settings.checkpoint_steps == 0 or now - last_saved > settings.checkpoint_seconds:
            run.save(step, facts or {})
            last_saved = time.monotonic()
        if finished:
            break
    if processes > 1:
        torch.distributed.barrier()  # the first process has written the files that every one returns
    best = run.out / "best.safetensors"
    return best if best.is_file() else run.out / "last.safetensors"


def _join_processes(device: str) -> tuple[int, int]:
    """(rank, number of processes) under torchrun, else (0, 1)."""
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    if processes > 1 and not torch.distributed.is_initialized():
        torch.distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
    return (int(os.environ["RANK"]), processes) if processes > 1 else (0, 1)


def _agreed(stop: bool, processes: int) -> bool:
    """True on every process when the first one wants to stop."""
    if processes == 1:
        return stop
    flag = torch.tensor([float(stop)])
    torch.distributed.broadcast(flag, 0)
    return bool(flag.item())


class _Run:
    """Network, optimiser and files of one run."""

    def __init__(self, settings: TrainSettings, samples: SampleSource, out: Path, rank: int, processes: int) -> None:
        self.settings, self.out, self.rank = settings, out, rank
        self.data = StepBatches(
            samples,
            settings.augmentation,
            settings.seed,
            settings.batch,
            settings.accumulate,
            settings.crops_per_frame,
            rank,
            processes,
        )
        self.steps_per_epoch = settings.steps_per_epoch or max(1, len(samples) // self.data.frames_per_step)
        self.planned = max(1, round(settings.epochs * self.steps_per_epoch))
        self.total = min(self.planned, settings.max_steps or self.planned)
        self.device = torch.device(settings.device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            model = build_model(settings.model)
        if settings.warm_start is not None:
            start, card = load_checkpoint(settings.warm_start)
            same = card.model.architecture == settings.model.architecture
            (grow if same else adopt)(start, model)
        self.model = model.to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.optimiser = torch.optim.Adam(
            self.model.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        self.scaler = torch.amp.GradScaler(self.device.type, enabled=settings.precision == "fp16")
        self.step, self.best = 0, float("inf")
        self.sums: dict[str, float] = {}  # loss parts since the last row of the log
        self.seconds = 0.0  # of training before this process
        self._resume()
        self.begun_at, self.begun = self.step, time.monotonic()
        self.forward: nn.Module = self.model
        if processes > 1:
            self.forward = nn.parallel.DistributedDataParallel(self.model)

    def _resume(self) -> None:
        path = self.out / "state.safetensors"
        if path.is_file():
            facts = load_state(path, self.model, self.optimiser, self.scaler)
            if facts["identity"] != self.settings.identity:
                raise ValueError(f"{self.out}: holds a run with other settings; give another folder or remove it")
            self.step, self.best, self.sums = facts["step"], facts["best"], facts["sums"]
            self.seconds = facts.get("seconds", 0.0)
        for name in ("log.csv", "validation.csv"):
            _keep_rows(self.out / name, self.step)

    def batches(self, start: int) -> Iterator[list[Batch]]:
        """Batches of the steps from `start` to the end."""
        workers = self.settings.workers
        loader: torch.utils.data.DataLoader[list[Batch]] = torch.utils.data.DataLoader(
            self.data,  # type: ignore[arg-type]
            batch_size=None,
            sampler=range(start, self.total),
            num_workers=workers,
            prefetch_factor=4 if workers else None,
            worker_init_fn=loader_worker,
        )
        return iter(loader)

    def optimise(self, step: int, batches: list[Batch]) -> None:
        """One optimiser step over its micro-batches; the mean loss parts are kept for the log."""
        settings = self.settings
        rate = learning_rate(settings, step, self.steps_per_epoch, self.planned)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.model.train()
        self.optimiser.zero_grad(set_to_none=True)
        sums: dict[str, Tensor] = {}
        for batch in batches:
            parts = self._loss(step, batch)
            self.scaler.scale(parts["loss"] / len(batches)).backward()
            for name, value in parts.items():
                sums[name] = sums.get(name, torch.zeros_like(value)).detach() + value.detach() / len(batches)
        if settings.clip_gradient:
            self.scaler.unscale_(self.optimiser)
            nn.utils.clip_grad_norm_(self.model.parameters(), settings.clip_gradient)
        self.scaler.step(self.optimiser)
        self.scaler.update()
        for name, value in sums.items():
            self.sums[name] = self.sums.get(name, 0.0) + float(value)
        self.sums["learning_rate"] = self.sums.get("learning_rate", 0.0) + rate
        self.sums["steps"] = self.sums.get("steps", 0.0) + 1

    def _loss(self, step: int, batch: Batch) -> dict[str, Tensor]:
        settings, spec = self.settings, self.settings.model
        sparse, rgb, target = (part.to(self.device, non_blocking=True) for part in batch)
        colours = scale_rgb(rgb, spec.rgb).contiguous(memory_format=torch.channels_last)
        kind = PRECISIONS[settings.precision]
        with torch.autocast(self.device.type, dtype=kind, enabled=kind is not None):
            outputs = self.forward(sparse / spec.depth_unit, colours)
        return training_loss(
            outputs if isinstance(outputs, tuple) else (outputs,),
            sparse,
            target,
            spec,
            settings.loss,
            scales_at(settings, step / self.steps_per_epoch),
            step / self.planned,
        )

    def log(self, step: int) -> dict[str, float]:
        """A row of log.csv, and TensorBoard scalars: means since the last row, of the first process' samples."""
        steps = self.sums.pop("steps")
        parts = {name: value / steps for name, value in self.sums.items()}
        self.sums = {}
        if not all(value == value for value in parts.values()):
            raise ValueError(f"{self.out}: the loss is NaN at step {step}; lower the learning rate or clip gradients")
        if self.rank == 0:
            _append(self.out / "log.csv", {"step": step} | parts)
            _tensorboard(self.out, step, parts)
        return parts

    def validate(self, step: int, validation: Sequence[DepthFrame], facts: dict[str, Any]) -> None:
        """Diagnose on the validation frames, log, and keep the best checkpoint."""
        if self.rank != 0:
            return
        found = diagnose(
            self._completer(), [validation[i] for i in range(min(len(validation), self.settings.validation_frames))]
        )
        _append(self.out / "validation.csv", {"step": step} | found)
        _tensorboard(self.out, step, {f"validation/{name}": value for name, value in found.items()})
        if found[self.settings.best_by] < self.best:
            self.best = found[self.settings.best_by]
            save_checkpoint(self.out / "best", self.model, self._card(step, facts | {"validation": found}))

    def save(self, step: int, facts: dict[str, Any]) -> None:
        """The last checkpoint, then the state that the run resumes from."""
        if self.rank != 0:
            return
        save_checkpoint(self.out / "last", self.model, self._card(step, facts))
        state = {
            "step": step,
            "best": self.best,
            "sums": self.sums,
            "seconds": self.spent,
            "identity": self.settings.identity,
        }
        save_state(self.out / "state.safetensors", self.model, self.optimiser, self.scaler, state)

    @property
    def spent(self) -> float:
        """Seconds of training so far, over all processes that continued the run; lost steps do not count."""
        return self.seconds + time.monotonic() - self.begun

    @property
    def decoding(self) -> str:
        return self.settings.decoding or default_decoding(self.settings.model)

    def _completer(self) -> NetworkCompleter:
        return network_completer(self.model, self.settings.model, self.device, self.decoding)

    def _card(self, step: int, facts: dict[str, Any]) -> Card:
        described = {
            "step": step,
            "hours": round(self.spent / 3600, 3),
            "settings": asdict(self.settings),
            "torch": torch.__version__,
        }
        return Card(self.settings.model, self.decoding, described | facts)


def _append(path: Path, row: dict[str, Any]) -> None:
    """Append a row to a CSV file; the header comes from the first row."""
    path.parent.mkdir(parents=True, exist_ok=True)
    is_new = not path.is_file() or path.stat().st_size == 0
    with open(path, "a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(row), lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerow(row)


def _keep_rows(path: Path, step: int) -> None:
    """Drop rows after `step`, written by a run that was killed before it saved its state."""
    if not path.is_file():
        return
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = lines[:1] + [line for line in lines[1:] if line.endswith("\n") and int(line.split(",", 1)[0]) <= step]
    path.write_text("".join(kept), encoding="utf-8")


def _tensorboard(out: Path, step: int, values: dict[str, float]) -> None:
    """Scalars for TensorBoard, when it is installed; log.csv has the same."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return
    with SummaryWriter(str(out / "tensorboard")) as writer:
        for name, value in values.items():
            writer.add_scalar(name, value, step)
