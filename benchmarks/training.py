"""Samples per second of both training loops beside the loop one would write: `python -m benchmarks.training`.

The obvious loops share loader, network and loss with ours; they read and crop every frame anew, keep torch's own memory
format, and normalise, rectify and take maxima in operations of their own. Data: synthetic frames of KITTI's size.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from benchmarks.batch import made_frames
from benchmarks.record import Measure, save
from completion.inputs import scale_rgb
from completion.models import ModelSpec, build_model, default_spec
from completion.samples import Augmentation, StepBatches
from completion.train import TrainSettings as DepthSettings
from completion.train import train as train_depth
from completion.training_loss import LossSettings, default_kind, training_loss
from detection.models import layers
from detection.train import Trainer, TrainSettings
from detection.training_batches import collate, prepare_sample, training_scene
from detection.types import PointFrame
from pipeline.data import Dataset, open_dataset
from pipeline.training.stage import DepthSamples


class Clouds:
    """Labelled clouds as `detection.train` reads them, with the seconds spent reading."""

    def __init__(self, dataset: Dataset) -> None:
        self.dataset = dataset

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> tuple[PointFrame, Any]:
        frame = self.dataset[index]
        camera = frame.calibration
        return PointFrame(frame.points, camera.T_cam_velo, camera.P2, frame.image_size, frame.id), frame.labels


def timed(run: Callable[[int], object], first: int, steps: int) -> float:
    """Seconds of steps first..first + steps."""
    start = time.perf_counter()
    for step in range(first, first + steps):
        run(step)
    return time.perf_counter() - start


def detection_measure(clouds: Clouds, steps: int, points: int) -> Measure:
    """The small detector: `Trainer.step` after its first epoch, and the obvious loop, in turns of one step."""
    settings = TrainSettings(options={"points": points}, steps=10_000)
    trainer = Trainer(settings, clouds)
    model: Any = trainer.preset.build()
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-3)

    def obvious(step: int) -> None:
        rng = np.random.default_rng(step)
        frames = [(step * settings.batch_size + k) % len(clouds) for k in range(settings.batch_size)]
        scenes = [training_scene(*clouds[index], trainer.preset) for index in frames]
        batch = collate([prepare_sample(one, trainer.preset, settings, [], rng) for one in scenes], torch.device("cpu"))
        optimiser.zero_grad()
        with patch.object(layers, "can_fuse", lambda _rows: False):
            model.train().training_losses(batch, rng)["loss"].backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()

    epoch = len(clouds) // settings.batch_size
    timed(trainer.step, 0, epoch)
    obvious(0)
    ours = theirs = loading = 0.0
    for step in range(epoch, epoch + steps):
        ours += timed(trainer.step, step, 1)
        loading += timed(trainer.batch, step, 1)
        theirs += timed(obvious, step, 1)
    print(f"detection, data and augmentation: {100 * loading / ours:.1f} % of a step\n")
    count = steps * settings.batch_size
    return Measure("training of the small detector", count / ours, "samples/s", {"obvious loop": count / theirs})


def completion_measure(dataset: Dataset, steps: int, crop: tuple[int, int]) -> Measure:
    """The bundled completion network on crops: `train`, and the obvious loop."""
    samples = DepthSamples(dataset)
    spec = default_spec("selection")
    loss_settings = LossSettings(default_kind(spec))
    augmentation = Augmentation(crop=crop)
    warm = 2  # steps that are timed apart: first calls, and what a run costs once
    ours = _trained(spec, loss_settings, samples, augmentation, warm + steps)
    ours -= _trained(spec, loss_settings, samples, augmentation, warm)
    batches = StepBatches(samples, augmentation, 0, 2, 1, 1, 0, 1)
    loading = timed(lambda step: batches[step], 0, steps)
    model = build_model(spec).train()
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-3)

    def obvious(step: int) -> None:
        sparse, rgb, target = batches[step][0]
        optimiser.zero_grad()
        outputs = model(sparse / spec.depth_unit, scale_rgb(rgb, spec.rgb))
        training_loss(outputs, sparse, target, spec, loss_settings, (1.0, 1.0, 1.0), 0.0)["loss"].backward()
        optimiser.step()

    timed(obvious, 0, warm)
    theirs = timed(obvious, warm, steps)
    print(f"completion, data and augmentation: {100 * loading / ours:.1f} % of a run without loader processes\n")
    return Measure(
        "training of the bundled completer", 2 * steps / ours, "samples/s", {"obvious loop": 2 * steps / theirs}
    )


def _trained(
    spec: ModelSpec, loss_settings: LossSettings, samples: DepthSamples, augmentation: Augmentation, steps: int
) -> float:
    """Seconds of a run of `train`."""
    settings = DepthSettings(
        spec, loss_settings, augmentation, epochs=10_000, max_steps=steps, batch_size=2, accumulate=1, log_every=steps
    )
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        train_depth(settings, samples, folder)
        return time.perf_counter() - start


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--data", type=Path, help="KITTI folder with labels and true depth; default: synthetic frames")
    parser.add_argument("--quick", action="store_true", help="small sizes: whether it runs, not how fast")
    parser.add_argument("--json")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    steps, points, crop = (1, 1024, (64, 96)) if options.quick else (options.steps, 8192, (192, 384))
    with tempfile.TemporaryDirectory() as folder:
        root = options.data or made_frames(Path(folder) / "data", 6)
        dataset = open_dataset("kitti_object", root)
        dataset = dataset.select(dataset.ids[:6])
        measures = [detection_measure(Clouds(dataset), steps, points), completion_measure(dataset, steps, crop)]
    print("| training | ours, samples/s | obvious loop | ratio |\n|---|---:|---:|---:|")
    for one in measures:
        peer = "obvious loop"
        print(f"| {one.case} | {one.ours:.2f} | {one.peers[peer]:.2f} | {one.ratio(peer):.2f} |")
    save(options.json, measures)


if __name__ == "__main__":
    main()
