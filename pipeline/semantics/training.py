"""Training of the segmentation network on frames with class maps."""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from auglidar_base.devices import check_device, resolve_device
from auglidar_base.errors import SettingsError
from auglidar_base.progress import Pace, TrainProgress
from auglidar_base.seeding import derived_seed, torch_seeded
from completion.resume import load_state, save_state
from completion.training_log import append_row, keep_rows
from pipeline.semantics.checkpoints import read_segmenter, save_segmenter
from pipeline.semantics.conventions import CLASSES, NONE
from pipeline.semantics.crops import CropSettings, draw_crop
from pipeline.semantics.inference import SegmentationNetwork
from pipeline.semantics.network import StreetSegmenter
from pipeline.semantics.pictures import LabelledImage, Normalisation, image_tensor
from pipeline.semantics.validation import validation_figures

# What random numbers are for: a generator derives from (seed, purpose, step).
_CROPS, _DROPOUT = 1, 2


@dataclass(frozen=True)
class SegmentationSettings(CropSettings):
    """One training run, and with the fields of `CropSettings` its crops.

    steps            updates of the weights in all, over which the schedule runs
    batch_size       crops of one update
    learning_rate    largest of one cosine cycle
    save_every       steps between saved states and last checkpoints
    validate_every   steps between validations; 0: only at the end
    device           "auto", "cpu", "cuda", "cuda:N" or "mps"
    seed             of everything random
    warm_start       weights (a path or a bundled name) to begin with, which also say which network; without them the
                     small one (`pipeline.semantics.network`) begins anew
    even_scores      the saved network's scores are freed of the weights that rare classes have in training, so that
                     they are shares of right pixels, for thresholds; the likeliest class then is seldom a rare one
    thresholds       for the card: scores from which a pixel is of a group, {vehicles: 0.5, people: 0.5}
    validation_frames  frames of a validation, at most
    best_by          the validation figure that chooses the best checkpoint, higher is better
    log_every        steps between rows of log.csv
    """

    RENAMED: ClassVar[Mapping[str, str]] = {"batch": "batch_size", "rate": "learning_rate"}

    steps: int = 3000
    batch_size: int = 6
    learning_rate: float = 3e-3
    save_every: int = 50
    validate_every: int = 0
    device: str = "cpu"
    seed: int = 0
    warm_start: str | None = None
    even_scores: bool = False
    thresholds: dict[str, float] = field(default_factory=dict)
    validation_frames: int = 50
    best_by: str = "mean_iou"
    log_every: int = 50

    def __post_init__(self) -> None:
        check_device(self.device)
        for name in ("steps", "batch_size", "learning_rate", "save_every", "log_every"):
            if not getattr(self, name) > 0:
                raise SettingsError(f"{name}: expected a value > 0, got {getattr(self, name)}")

    def identity(self, samples: int) -> str:
        """JSON of everything that determines the weights; a run resumes only under the same one."""
        values = asdict(self)
        for free in (
            "save_every",
            "validate_every",
            "validation_frames",
            "best_by",
            "log_every",
            "device",
            "thresholds",
        ):
            del values[free]
        return json.dumps(values | {"samples": samples}, sort_keys=True)


def train_segmenter(
    settings: SegmentationSettings,
    samples: Sequence[LabelledImage],
    out: Path,
    validation: Sequence[LabelledImage] = (),
    progress: Callable[[TrainProgress], None] | None = None,
) -> Path:
    """Train on random crops by cross-entropy, or continue the run in `out`, and return the best checkpoint (the last
    one without validation frames).

    Rare classes count more (inverse square root of their frequency in the first 50 samples). AdamW with one cosine
    cycle. The same arguments give the same weights on one machine, also when the run was killed and started again, and
    the caller's random generators stay as they are. `out` receives state.safetensors (for resuming), last and best
    .safetensors with cards, log.csv and validation.csv.

    progress  called with every row of log.csv
    Raises SettingsError without samples, and for a state of other settings.
    """
    if not len(samples):
        raise SettingsError("segmentation training: expected at least one sample, got none")
    run = _Run(samples, settings, out)
    while run.step < settings.steps:
        run.optimise()
        finished = run.step == settings.steps
        if finished or run.step % settings.log_every == 0:
            losses = run.log()
            if progress is not None:
                progress(run.pace.progress(run.step, settings.steps, losses, time.monotonic()))
        validate = settings.validate_every > 0 and run.step % settings.validate_every == 0
        if len(validation) and (finished or validate):
            run.validate(validation)
        if finished or run.step % settings.save_every == 0:
            run.save()
    best = out / "best.safetensors"
    return best if best.is_file() else out / "last.safetensors"


def _first_model(settings: SegmentationSettings) -> SegmentationNetwork:
    """The network before the first step, on the CPU."""
    if settings.warm_start is not None:
        return read_segmenter(settings.warm_start)[0]
    with torch_seeded(settings.seed, torch.device("cpu")):
        return StreetSegmenter()


class _Run:
    """Network, optimiser and files of one training."""

    def __init__(self, samples: Sequence[LabelledImage], settings: SegmentationSettings, folder: Path) -> None:
        self.samples, self.settings, self.folder = samples, settings, folder
        self.device = resolve_device(settings.device)
        self.model: SegmentationNetwork = _first_model(settings).to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        groups = self.model.parameter_groups(settings.learning_rate)
        rates = [group["lr"] for group in groups]
        self.optimiser = torch.optim.AdamW(groups, weight_decay=1e-4)
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(self.optimiser, rates, total_steps=settings.steps)
        self.weights = _class_weights(samples).to(self.device)
        self.step, self.best = 0, -1.0
        self.losses: list[float] = []  # since the last row of the log
        self.scaler = torch.amp.GradScaler("cpu", enabled=False)  # part of a state's format
        self.pace = Pace(*self._resume(), time.monotonic())

    def optimise(self) -> None:
        """One update."""
        settings = self.settings
        random = np.random.default_rng([settings.seed, _CROPS, self.step])
        crops = _crops(self.samples, settings, self.model.normalisation, random)
        images, labels = (part.to(self.device) for part in crops)
        # At half size, as `NetworkSegmenter` labels: the 19 maps of full size would cost a quarter of the step.
        labels = labels[:, ::2, ::2]
        self.model.train()
        with torch_seeded(derived_seed(settings.seed, _DROPOUT, self.step), self.device):
            logits = F.interpolate(self.model(images), size=labels.shape[-2:], mode="bilinear", align_corners=False)
            loss = F.cross_entropy(logits, labels, weight=self.weights, ignore_index=NONE)
            self.optimiser.zero_grad()
            loss.backward()
        self.optimiser.step()
        self.schedule.step()
        self.losses.append(float(loss.detach()))
        self.step += 1

    def log(self) -> dict[str, float]:
        """A row of log.csv: means since the last row."""
        means = {"loss": float(np.mean(self.losses))}
        self.losses = []
        append_row(self.folder / "log.csv", {"step": self.step} | means)
        return means

    def validate(self, validation: Sequence[LabelledImage]) -> None:
        """A row of validation.csv; the best checkpoint is kept."""
        frames = [validation[index] for index in range(min(len(validation), self.settings.validation_frames))]
        figures = validation_figures(self.model.eval(), frames, self.device)
        append_row(self.folder / "validation.csv", {"step": self.step} | figures)
        if self.settings.best_by not in figures:
            raise SettingsError(f"best_by: expected one of {', '.join(figures)}, got {self.settings.best_by!r}")
        if figures[self.settings.best_by] >= self.best:
            self.best = figures[self.settings.best_by]
            self.checkpoint("best", {"validation": figures})

    def checkpoint(self, name: str, facts: dict[str, Any]) -> None:
        """NAME.safetensors with its card."""
        hours = round(self.pace.spent(time.monotonic()) / 3600, 3)
        described = asdict(self.settings) | {"samples": len(self.samples), "step": self.step, "hours": hours}
        model = _with_even_scores(self.model, self.weights) if self.settings.even_scores else self.model
        save_segmenter(model, self.folder / name, described | facts, self.settings.thresholds)

    def save(self) -> None:
        """The last checkpoint, then the state that the run resumes from."""
        self.checkpoint("last", {})
        facts = {
            "identity": self.settings.identity(len(self.samples)),
            "step": self.step,
            "best": self.best,
            "seconds": self.pace.spent(time.monotonic()),
            "losses": self.losses,
            "groups": [{"lr": group["lr"], "betas": group["betas"]} for group in self.optimiser.param_groups],
        }
        save_state(self.folder / "state.safetensors", self.model, self.optimiser, self.scaler, facts)

    def _resume(self) -> tuple[int, float]:
        """The steps done and the seconds they took."""
        path, seconds = self.folder / "state.safetensors", 0.0
        if path.is_file():
            facts = load_state(path, self.model, self.optimiser, self.scaler)
            if facts["identity"] != self.settings.identity(len(self.samples)):
                raise SettingsError(f"{path}: the state of a run with other settings; use another folder or remove it")
            self.step, self.best, seconds = facts["step"], facts["best"], facts["seconds"]
            self.losses = list(facts["losses"])
            self.schedule.last_epoch = self.step
            for group, values in zip(self.optimiser.param_groups, facts["groups"]):
                group |= {"lr": values["lr"], "betas": tuple(values["betas"])}
        for name in ("log.csv", "validation.csv"):
            keep_rows(self.folder / name, self.step)
        return self.step, seconds


def _with_even_scores(model: SegmentationNetwork, weights: Tensor) -> SegmentationNetwork:
    """A copy whose scores p' are those of training without class weights: p' is proportional to p / weight."""
    even = copy.deepcopy(model)
    seen = torch.where(weights > 0, weights, torch.ones_like(weights))
    with torch.no_grad():
        assert even.classify.bias is not None
        even.classify.bias -= seen.log()
    return even


def _class_weights(samples: Sequence[LabelledImage]) -> Tensor:
    """(19,) weights, 1 on average over the classes that occur."""
    seen = min(50, len(samples))
    counts = sum(np.bincount(samples[i].semantics.reshape(-1), minlength=256)[: len(CLASSES)] for i in range(seen))
    frequency = np.asarray(counts, dtype=np.float64) / max(float(np.sum(counts)), 1.0)
    weights = np.where(frequency > 0, 1 / np.sqrt(np.maximum(frequency, 1e-4)), 0)
    return torch.from_numpy(weights / weights[weights > 0].mean()).float()


def _crops(
    samples: Sequence[LabelledImage],
    settings: SegmentationSettings,
    normalisation: Normalisation,
    random: np.random.Generator,
) -> tuple[Tensor, Tensor]:
    """(B, 3, h, w) images and (B, h, w) labels. Two crops are taken of every frame that is read."""
    images, labels = [], []
    for number in range(settings.batch_size):
        if number % 2 == 0:
            sample = samples[int(random.integers(len(samples)))]
            whole, classes = sample.image, sample.semantics
        image, semantics = draw_crop(whole, classes, settings, random)
        images.append(image_tensor(image, normalisation))
        labels.append(torch.from_numpy(np.ascontiguousarray(semantics)).long())
    return torch.cat(images).contiguous(memory_format=torch.channels_last), torch.stack(labels)
