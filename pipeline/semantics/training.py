"""Training of the segmentation network on frames with class maps."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from auglidar_base.atomic import write_text
from completion.resume import load_state, save_state
from completion.samples import Augmentation, disturb_image
from completion.train import TrainProgress
from pipeline.semantics.checkpoints import save_segmenter
from pipeline.semantics.conventions import CLASSES, NONE
from pipeline.semantics.network import StreetSegmenter
from pipeline.semantics.pictures import LabelledImage, image_tensor

LOG_EVERY = 50


@dataclass(frozen=True)
class SegmentationSettings:
    """One training run.

    steps, batch  updates, crops per update        crop  (height, width) in pixels
    rate          largest learning rate of one cosine cycle
    zoom          crops are enlarged by up to this factor or reduced by its inverse
    jitter, gamma, noise   of colours, as `completion.samples.Augmentation`; grey  share of crops without colour
    """

    steps: int = 3000
    batch: int = 6
    crop: tuple[int, int] = (256, 384)
    rate: float = 3e-3
    seed: int = 0
    zoom: float = 1.5
    jitter: float = 0.4
    gamma: float = 0.5
    noise: float = 8.0
    grey: float = 0.15


def train_segmenter(
    samples: Sequence[LabelledImage],
    out: Path,
    settings: SegmentationSettings,
    progress: Callable[[TrainProgress], None] | None = None,
) -> Path:
    """Train on random crops by cross-entropy and write OUT.safetensors with its card OUT.json; returns the weights.

    Rare classes count more (inverse square root of their frequency in the first 50 samples). AdamW with one cosine
    cycle. The same arguments give the same weights on one machine, also when the run was killed and started again: the
    folder of OUT also holds state.safetensors and log.csv, written every 50 steps, when `progress` is called too.

    Raises ValueError without samples or steps, and for a state of other settings.
    """
    if not len(samples) or settings.steps < 1:
        raise ValueError(f"segmentation training: expected samples and steps, got {len(samples)} and {settings.steps}")
    run = _Run(samples, settings, out.parent)
    begun_at, before = run.step, run.seconds
    while run.step < settings.steps:
        run.optimise()
        if run.step % LOG_EVERY == 0 or run.step == settings.steps:
            loss = run.save()
            if progress is not None:
                taken, done = run.seconds - before, run.step - begun_at
                progress(TrainProgress.after(taken, done, run.step, settings.steps, {"loss": loss}))
    training = asdict(settings) | {"samples": len(samples), "final_loss": run.log[-1][1]}
    return save_segmenter(run.model.eval(), out, training | {"hours": round(run.seconds / 3600, 3)})


class _Run:
    """Network, optimiser, random numbers and files of one training."""

    def __init__(self, samples: Sequence[LabelledImage], settings: SegmentationSettings, folder: Path) -> None:
        self.samples, self.settings, self.folder = samples, settings, folder
        torch.manual_seed(settings.seed)
        self.random = np.random.default_rng(settings.seed)
        self.model = StreetSegmenter().train().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.optimiser = torch.optim.AdamW(self.model.parameters(), lr=settings.rate, weight_decay=1e-4)
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(self.optimiser, settings.rate, total_steps=settings.steps)
        self.weights = _class_weights(samples)
        self.step, self.seconds = 0, 0.0
        self.losses: list[float] = []  # since the last row of the log
        self.log: list[tuple[int, float]] = []
        self.scaler = torch.amp.GradScaler("cpu", enabled=False)  # part of a state's format
        self._resume()

    def optimise(self) -> None:
        """One update."""
        begun = time.monotonic()
        images, labels = _crops(self.samples, self.settings, self.random)
        # At half size, as `NetworkSegmenter` labels: the 19 maps of full size would cost a quarter of the step.
        labels = labels[:, ::2, ::2]
        logits = F.interpolate(self.model(images), size=labels.shape[-2:], mode="bilinear", align_corners=False)
        loss = F.cross_entropy(logits, labels, weight=self.weights, ignore_index=NONE)
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        self.schedule.step()
        self.losses.append(float(loss.detach()))
        self.step += 1
        self.seconds += time.monotonic() - begun

    def save(self) -> float:
        """A row of the log, then the state; returns the mean loss since the last row."""
        self.log.append((self.step, float(np.mean(self.losses))))
        self.losses = []
        write_text(self.folder / "log.csv", "".join(f"{a},{b}\n" for a, b in [("step", "loss"), *self.log]))
        facts = {
            "identity": self._identity,
            "step": self.step,
            "seconds": self.seconds,
            "log": self.log,
            "random": self.random.bit_generator.state,
            "groups": [{"lr": group["lr"], "betas": group["betas"]} for group in self.optimiser.param_groups],
        }
        save_state(self.folder / "state.safetensors", self.model, self.optimiser, self.scaler, facts)
        return self.log[-1][1]

    def _resume(self) -> None:
        path = self.folder / "state.safetensors"
        if not path.is_file():
            return
        facts = load_state(path, self.model, self.optimiser, self.scaler)
        if facts["identity"] != self._identity:
            raise ValueError(f"{path}: the state of a run with other settings; use another output folder or remove it")
        self.step, self.seconds = facts["step"], facts["seconds"]
        self.log = [(step, loss) for step, loss in facts["log"]]
        self.random.bit_generator.state = facts["random"]
        self.schedule.last_epoch = self.step
        for group, values in zip(self.optimiser.param_groups, facts["groups"]):
            group |= {"lr": values["lr"], "betas": tuple(values["betas"])}

    @property
    def _identity(self) -> str:
        """What must agree for a run to be continued."""
        return json.dumps(asdict(self.settings) | {"samples": len(self.samples)}, sort_keys=True)


def _class_weights(samples: Sequence[LabelledImage]) -> Tensor:
    """(19,) weights, 1 on average over the classes that occur."""
    seen = min(50, len(samples))
    counts = sum(np.bincount(samples[i].semantics.reshape(-1), minlength=256)[: len(CLASSES)] for i in range(seen))
    frequency = np.asarray(counts, dtype=np.float64) / max(float(np.sum(counts)), 1.0)
    weights = np.where(frequency > 0, 1 / np.sqrt(np.maximum(frequency, 1e-4)), 0)
    return torch.from_numpy(weights / weights[weights > 0].mean()).float()


def _crops(
    samples: Sequence[LabelledImage], settings: SegmentationSettings, random: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """(B, 3, h, w) images and (B, h, w) labels. Two crops are taken of every frame that is read."""
    colours = Augmentation(jitter=settings.jitter, gamma=settings.gamma, noise=settings.noise)
    images, labels = [], []
    for number in range(settings.batch):
        if number % 2 == 0:
            sample = samples[int(random.integers(len(samples)))]
            whole, classes = sample.image, sample.semantics
        image, semantics = _crop(whole, classes, settings, random)
        image = disturb_image(image, colours, random)
        if random.random() < settings.grey:
            image = np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8)
        images.append(image_tensor(image))
        labels.append(torch.from_numpy(np.ascontiguousarray(semantics)).long())
    return torch.cat(images).contiguous(memory_format=torch.channels_last), torch.stack(labels)


def _crop(
    image: NDArray[np.uint8], semantics: NDArray[np.uint8], settings: SegmentationSettings, random: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A random place at a random size, mirrored half of the time, brought to the crop's size."""
    height, width = settings.crop
    factor = float(np.exp(random.uniform(-1, 1) * np.log(settings.zoom)))
    taken = (round(height / factor), round(width / factor))
    image, semantics = _padded(image, taken), _padded(semantics, taken, NONE)
    top = int(random.integers(image.shape[0] - taken[0] + 1))
    left = int(random.integers(image.shape[1] - taken[1] + 1))
    image = image[top : top + taken[0], left : left + taken[1]]
    semantics = semantics[top : top + taken[0], left : left + taken[1]]
    if random.random() < 0.5:
        image, semantics = image[:, ::-1], semantics[:, ::-1]
    size = (width, height)
    resized = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_LINEAR)
    labels = cv2.resize(np.ascontiguousarray(semantics), size, interpolation=cv2.INTER_NEAREST)
    return resized.astype(np.uint8), labels.astype(np.uint8)


def _padded(values: NDArray[Any], crop: tuple[int, int], fill: int = 0) -> NDArray[Any]:
    """At least the crop's size, filled at the bottom and on the right."""
    missing = [max(0, want - have) for want, have in zip(crop, values.shape[:2])]
    borders = [(0, missing[0]), (0, missing[1])] + [(0, 0)] * (values.ndim - 2)
    return np.pad(values, borders, constant_values=fill) if any(missing) else values
