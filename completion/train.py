"""Training of every network of this library by one plain loop.

A loop of one's own rather than a training framework: resume has to be exact to the bit after SIGKILL, and the whole of
it, data order included, has to be readable on one screen. Distribution is torchrun's: start the same command with
`torchrun --nproc-per-node N`, each process takes its part of every step.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from auglidar_base.children import loader_worker
from auglidar_base.devices import resolve_device
from auglidar_base.errors import SettingsError
from auglidar_base.progress import Pace, TrainProgress
from auglidar_base.seeding import derived_seed, torch_seeded
from completion.checkpoints import Card, load_checkpoint, save_checkpoint
from completion.decoding import default_decoding
from completion.diagnostics import diagnose
from completion.growth import adopt, grow
from completion.infer import Completer, network_completer
from completion.inputs import scale_rgb
from completion.models import build_model
from completion.resume import load_state, save_state
from completion.samples import Batch, SampleSource, StepBatches
from completion.train_settings import PRECISIONS, TrainSettings, learning_rate, scales_at
from completion.training_log import append_row, keep_rows, show_in_tensorboard
from completion.training_loss import training_loss
from completion.types import DepthFrame
from completion.windows import batch_view

__all__ = ["TrainProgress", "TrainSettings", "learning_rate", "scales_at", "train"]

# What random numbers are for: `completion.samples` uses 0 (order of the frames) and 1 (crops).
_DROPOUT = 2


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

    samples     `samples[i]` is a DepthFrame with target, or a TrainingSample or DrawnSample
    validation  frames with target; the diagnostics of each validation are logged
    facts       goes into the cards: data, command, ...
    seconds     stop after about this much time, with the state saved; call again to go on
    progress    called with every row of log.csv, in the first process

    The caller's random generators stay as they are. Raises SettingsError when settings, samples, machine and the run in
    `out` do not fit together.
    """
    device = resolve_device(settings.device)
    rank, processes = _join_processes(device)
    run = _Run(settings, samples, Path(out), device, rank, processes)
    step, last_saved = run.step, run.pace.begun
    for batches in run.batches(step):
        run.optimise(step, batches)
        step += 1
        now = time.monotonic()
        finished = step == run.total or _agreed(seconds is not None and now - run.pace.begun > seconds, processes)
        validate = bool(settings.validate_every) and step % settings.validate_every == 0
        if step % settings.log_every == 0 or finished:
            losses = run.log(step)
            if progress is not None and rank == 0:
                progress(run.pace.progress(step, run.total, losses, now))
        if len(validation) and (validate or step == run.total):
            run.validate(step, validation, facts or {})
        if finished or step % settings.save_every == 0 or now - last_saved > settings.save_seconds:
            run.save(step, facts or {})
            last_saved = time.monotonic()
        if finished:
            break
    if processes > 1:
        torch.distributed.barrier()  # the first process has written the files that every one returns
    best = run.out / "best.safetensors"
    return best if best.is_file() else run.out / "last.safetensors"


def _join_processes(device: torch.device) -> tuple[int, int]:
    """(rank, number of processes) under torchrun, else (0, 1)."""
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    if processes > 1 and not torch.distributed.is_initialized():
        torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return (int(os.environ["RANK"]), processes) if processes > 1 else (0, 1)


def _agreed(stop: bool, processes: int) -> bool:
    """True on every process when the first one wants to stop."""
    if processes == 1:
        return stop
    flag = torch.tensor([float(stop)])
    torch.distributed.broadcast(flag, 0)
    return bool(flag.item())


def _first_model(settings: TrainSettings) -> nn.Module:
    """The network before the first step, on the CPU."""
    with torch_seeded(settings.seed, torch.device("cpu")):
        model = build_model(settings.model)
        if settings.warm_start is not None:
            start, card = load_checkpoint(settings.warm_start)
            same = card.model.architecture == settings.model.architecture
            (grow if same else adopt)(start, model)
    return model


class _Run:
    """Network, optimiser and files of one run."""

    def __init__(
        self, settings: TrainSettings, samples: SampleSource, out: Path, device: torch.device, rank: int, processes: int
    ) -> None:
        if settings.precision != "fp32" and device.type != "cuda":
            raise SettingsError(f"precision {settings.precision!r} is for a GPU, there is none; use 'fp32'")
        self.settings, self.out, self.device, self.rank = settings, out, device, rank
        self.data = StepBatches(
            samples,
            settings.augmentation,
            settings.seed,
            settings.batch_size,
            settings.accumulate,
            settings.crops_per_frame,
            rank,
            processes,
        )
        self.steps_per_epoch = settings.steps_per_epoch or max(1, len(samples) // self.data.frames_per_step)
        self.planned = settings.steps or max(1, round(settings.epochs * self.steps_per_epoch))
        self.total = min(self.planned, settings.max_steps or self.planned)
        self.model = _first_model(settings).to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.optimiser = torch.optim.Adam(
            self.model.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        self.scaler = torch.amp.GradScaler(self.device.type, enabled=settings.precision == "fp16")
        self.step, self.best = 0, float("inf")
        self.sums: dict[str, float] = {}  # loss parts since the last row of the log
        self.pace = Pace(*self._resume(), time.monotonic())
        self.forward: nn.Module = self.model
        if processes > 1:
            self.forward = nn.parallel.DistributedDataParallel(self.model)

    def _resume(self) -> tuple[int, float]:
        """The steps done and the seconds they took."""
        path, seconds = self.out / "state.safetensors", 0.0
        if path.is_file():
            facts = load_state(path, self.model, self.optimiser, self.scaler)
            if facts["identity"] != self.settings.identity:
                raise SettingsError(f"{self.out}: holds a run with other settings; give another folder or remove it")
            self.step, self.best, self.sums = facts["step"], facts["best"], facts["sums"]
            seconds = facts["seconds"]
        for name in ("log.csv", "validation.csv"):
            keep_rows(self.out / name, self.step)
        return self.step, seconds

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
            generator=torch.Generator().manual_seed(self.settings.seed),  # else it draws from the caller's
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
        with torch_seeded(derived_seed(settings.seed, _DROPOUT, step, self.rank), self.device):
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
        sparse, rgb, target, place, K = (part.to(self.device, non_blocking=True) for part in batch)
        colours = scale_rgb(rgb, spec.rgb).contiguous(memory_format=torch.channels_last)
        kind = PRECISIONS[settings.precision]
        with torch.autocast(self.device.type, dtype=kind, enabled=kind is not None):
            outputs = self.forward(sparse / spec.depth_unit, colours, *batch_view(spec, sparse, place, K))
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
            raise SettingsError(f"{self.out}: the loss is NaN at step {step}; lower learning_rate or set clip_gradient")
        if self.rank == 0:
            append_row(self.out / "log.csv", {"step": step} | parts)
            show_in_tensorboard(self.out, step, parts)
        return parts

    def validate(self, step: int, validation: Sequence[DepthFrame], facts: dict[str, Any]) -> None:
        """Diagnose on the validation frames, log, and keep the best checkpoint."""
        if self.rank != 0:
            return
        found = diagnose(
            self._completer(), [validation[i] for i in range(min(len(validation), self.settings.validation_frames))]
        )
        append_row(self.out / "validation.csv", {"step": step} | found)
        show_in_tensorboard(self.out, step, {f"validation/{name}": value for name, value in found.items()})
        if self.settings.best_by not in found:
            raise SettingsError(f"best_by: expected one of {', '.join(found)}, got {self.settings.best_by!r}")
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
        """Seconds of training so far."""
        return self.pace.spent(time.monotonic())

    @property
    def decoding(self) -> str:
        return self.settings.decoding or default_decoding(self.settings.model)

    def _completer(self) -> Completer:
        return network_completer(self.model, self.settings.model, self.device, self.decoding)

    def _card(self, step: int, facts: dict[str, Any]) -> Card:
        described = {
            "step": step,
            "hours": round(self.spent / 3600, 3),
            "settings": asdict(self.settings),
            "torch": torch.__version__,
        }
        return Card(self.settings.model, self.decoding, described | facts)
