"""Training a detector on frames with labels: by steps, resumable to the bit, in one or several processes.

Everything random at a step derives from (seed, step, rank), so a run that was killed continues exactly as if it had not
been. Several processes (torchrun, or `train_in_processes`) average their gradients after each backward pass.
"""

from __future__ import annotations

import dataclasses
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray
from torch import Tensor

from auglidar_base.children import end_with_parent
from detection.checkpoints import load_checkpoint, load_tensors, save_checkpoint, save_tensors
from detection.data_augmentation import (
    DatabaseObject,
    PasteSettings,
    SceneAugmentation,
    TrainingScene,
    augment_scene,
    cut_objects,
    paste_objects,
)
from detection.inputs import CameraCloud, camera_cloud, ground_height, network_input, truth_boxes
from detection.kitti_format import KittiObject, boxes_of
from detection.lidar_inputs import camera_axes_boxes, camera_axes_cloud, lidar_boxes, lidar_rows
from detection.models.added_classes import with_classes
from detection.models.batch import DetectorModel, PointBatch
from detection.models.layers import set_batchnorm_momentum
from detection.models.presets import PRESETS, Preset
from detection.models.warm_start import copy_matching
from detection.optimiser import AdamOneCycle, OneCycleSettings, batchnorm_momentum
from detection.training_log import TrainingLog
from detection.types import PointFrame


class LabelledFrames(Protocol):
    """A data source: its length, and frame i with its labels."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> tuple[PointFrame, list[KittiObject]]: ...


@dataclass(frozen=True)
class TrainSettings:
    """One training run.

    preset, options  the detector, PRESETS[preset](**options)
    steps            updates in all        batch_size  frames per process and update
    optimiser        the one-cycle schedule, over `steps`
    scene            scene augmentation, or None (the thesis uses none)
    paste            ground truth sampling, or None; objects come from `paste_frames` frames drawn at the start
    warm_start       weights to begin with, of the same network or of its first stage alone; input channels they lack
                     start at zero, classes as a copy of similar ones
    save_every, log_every  steps
    cache_mb         memory for the visible points of frames, which are then read once instead of once per epoch
    """

    preset: str = "small"
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    steps: int = 20000
    batch_size: int = 2
    seed: int = 0
    optimiser: OneCycleSettings = dataclasses.field(default_factory=OneCycleSettings)
    scene: SceneAugmentation | None = dataclasses.field(default_factory=SceneAugmentation)
    paste: PasteSettings | None = None
    paste_frames: int = 200
    warm_start: str | None = None
    save_every: int = 500
    log_every: int = 20
    cache_mb: int = 1500


@dataclass(frozen=True)
class TrainProgress:
    """What a progress callback is told: step (1-based) of steps, epoch, mean losses since the last call, seconds per
    step, and the seconds that remain."""

    step: int
    steps: int
    epoch: int
    losses: dict[str, float]
    seconds_per_step: float
    eta_seconds: float


@dataclass(frozen=True)
class _Workers:
    """This process among those of the run."""

    rank: int
    count: int

    @classmethod
    def current(cls) -> _Workers:
        """From torchrun's environment; alone without it."""
        if "RANK" in os.environ and "WORLD_SIZE" in os.environ and not dist.is_initialized():
            dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
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


def frame_order(step: int, frames: int, settings: TrainSettings, rank: int, workers: int) -> list[int]:
    """Frames of a step for one process: consecutive places of a permutation drawn anew for every epoch."""
    first = (step * workers + rank) * settings.batch_size
    chosen = []
    for place in range(first, first + settings.batch_size):
        epoch, within = divmod(place, frames)
        chosen.append(int(np.random.default_rng([settings.seed, 1, epoch]).permutation(frames)[within]))
    return chosen


def training_scene(frame: PointFrame, labels: Sequence[KittiObject], preset: Preset) -> TrainingScene:
    """The visible points, their heights and the boxes of one frame, in the camera frame (or turned LiDAR axes)."""
    truth = truth_boxes(labels, preset.classes)
    obstacles = boxes_of([item for item in labels if item.type != "DontCare" and min(item.size) > 0]).values
    cloud, boxes = camera_cloud(frame), truth.boxes
    if preset.inputs.frame == "lidar":
        cloud = camera_axes_cloud(frame)
        boxes, obstacles = camera_axes_boxes(boxes, frame), camera_axes_boxes(obstacles, frame)
    points = np.concatenate([cloud.xyz, cloud.columns], axis=1)
    return TrainingScene(points, ground_height(cloud.xyz), boxes, truth.classes, obstacles)


def object_database(samples: LabelledFrames, preset: Preset, settings: TrainSettings) -> list[DatabaseObject]:
    """Objects to paste, cut out of `paste_frames` frames drawn by the seed."""
    if settings.paste is None:
        return []
    rng = np.random.default_rng([settings.seed, 2])
    chosen = rng.permutation(len(samples))[: settings.paste_frames]
    scenes = (training_scene(*samples[int(index)], preset) for index in chosen)
    return [item for scene in scenes for item in cut_objects(scene, settings.paste.min_points)]


class Scenes:
    """The training scenes of a data source, each made from its files once while `megabytes` of memory last."""

    def __init__(self, samples: LabelledFrames, preset: Preset, megabytes: int) -> None:
        self.samples, self.preset = samples, preset
        self.free = megabytes * 10**6
        self.kept: dict[int, TrainingScene] = {}

    def __getitem__(self, index: int) -> TrainingScene:
        """The scene of a frame, or of the next usable one: with visible points and, where the preset asks, a box."""
        count = len(self.samples)
        for place in range(index, index + count):
            scene = self._scene(place % count)
            if len(scene.points) and (len(scene.boxes) or not self.preset.skip_empty_frames):
                return scene
        raise ValueError(
            f"training: none of the {count} frames has visible points and an object of {', '.join(self.preset.classes)}"
        )

    def _scene(self, index: int) -> TrainingScene:
        if index in self.kept:
            return self.kept[index]
        scene = training_scene(*self.samples[index], self.preset)
        size = scene.points.nbytes + scene.height.nbytes
        if size <= self.free:
            self.free -= size
            self.kept[index] = scene
        return scene


@dataclass(frozen=True)
class _Prepared:
    points: NDArray[np.float32]
    cloud: NDArray[np.float32]
    boxes: NDArray[np.float64]
    classes: NDArray[np.int64]


def prepare_sample(
    scene: TrainingScene,
    preset: Preset,
    settings: TrainSettings,
    database: Sequence[DatabaseObject],
    rng: np.random.Generator,
) -> _Prepared:
    """Augment a scene and draw the network's points."""
    if settings.paste is not None:
        scene = paste_objects(scene, database, settings.paste, rng)
    if settings.scene is not None:
        scene = augment_scene(scene, settings.scene, rng)
    cloud = CameraCloud(scene.points[:, :3], scene.points[:, 3:])
    if preset.inputs.frame == "lidar":
        rows = rng.permutation(lidar_rows(cloud, scene.height, preset.inputs.features))
        return _Prepared(rows[:0], rows, lidar_boxes(scene.boxes), scene.classes)
    points, full = network_input(cloud, scene.height, preset.inputs, rng)
    return _Prepared(points, full, scene.boxes, scene.classes)


def collate(samples: Sequence[_Prepared], device: torch.device) -> PointBatch:
    """A batch on the device."""

    def on_device(values: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(device)

    return PointBatch(
        points=torch.stack([on_device(item.points) for item in samples]),
        clouds=[on_device(item.cloud) for item in samples],
        boxes=[on_device(item.boxes.astype(np.float32)) for item in samples],
        classes=[on_device(item.classes) for item in samples],
    )


class Trainer:
    """The state of a run and its one step."""

    def __init__(self, settings: TrainSettings, samples: LabelledFrames, device: str) -> None:
        if len(samples) == 0:
            raise ValueError("training: expected at least one frame, got an empty data source")
        self.settings, self.device = settings, torch.device(device)
        self.workers = _Workers.current()
        if settings.preset not in PRESETS:
            raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, got {settings.preset!r}")
        self.preset = PRESETS[settings.preset](**settings.options)
        torch.manual_seed(settings.seed)
        self.model = self.preset.build().to(self.device)
        if not hasattr(self.model, "training_losses"):
            raise ValueError(f"preset {settings.preset}: its network can be imported and run, but not trained")
        if settings.warm_start is not None:
            start = load_checkpoint(settings.warm_start)[0]
            copy_matching(with_classes(start, self.preset.classes), self.model)
        self.optimiser = AdamOneCycle(self.model, settings.steps, settings.optimiser)
        self.scenes = Scenes(samples, self.preset, settings.cache_mb)
        self.database = object_database(samples, self.preset, settings)
        self.epoch_steps = max(1, len(samples) // (settings.batch_size * self.workers.count))
        self.seconds, self.begun = 0.0, time.perf_counter()  # of training before this process; start of this one

    @property
    def spent(self) -> float:
        """Seconds of training so far, over all processes that continued the run; lost steps do not count."""
        return self.seconds + time.perf_counter() - self.begun

    def batch(self, step: int) -> PointBatch:
        """The frames of a step, prepared with the step's own random numbers."""
        rng = np.random.default_rng([self.settings.seed, 3, step, self.workers.rank])
        order = frame_order(step, len(self.scenes.samples), self.settings, self.workers.rank, self.workers.count)
        prepared = [
            prepare_sample(self.scenes[index], self.preset, self.settings, self.database, rng) for index in order
        ]
        return collate(prepared, self.device)

    def step(self, step: int) -> dict[str, float]:
        """One update; returns the losses and the norm of the gradient."""
        batch = self.batch(step)
        seeds = np.random.SeedSequence([self.settings.seed, 4, step, self.workers.rank])
        torch.manual_seed(int(seeds.generate_state(1, np.uint64)[0] >> 1))
        self.model.train()
        if self.preset.norm_schedule:
            set_batchnorm_momentum(self.model, batchnorm_momentum(step, self.epoch_steps))
        losses = cast(DetectorModel, self.model).training_losses(batch, np.random.default_rng(seeds.spawn(1)[0]))
        if not bool(torch.isfinite(losses["loss"])):
            raise ValueError(f"training: the loss is not finite at step {step + 1}; lower optimiser.peak")
        losses["loss"].backward()
        gradients = [parameter.grad for parameter in self.optimiser.parameters if parameter.grad is not None]
        self.workers.average(gradients)
        norm = self.optimiser.step(step)
        # Running statistics too, so that every process holds the same network.
        self.workers.average([buffer for buffer in self.model.buffers() if buffer.is_floating_point()])
        return {**{name: float(value.detach()) for name, value in losses.items()}, "gradient_norm": norm}

    def save(self, path: Path, done: int) -> None:
        """The complete state after `done` steps, atomically."""
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= {f"adam.{name}": value for name, value in self.optimiser.state_tensors().items()}
        settings = _settings_text(self.settings, self.workers.count)
        save_tensors(path, tensors, {"done": str(done), "seconds": f"{self.spent:.1f}", "settings": settings})

    def resume(self, path: Path) -> int:
        """Load the state if there is one; returns the steps done. Raises ValueError for the state of another run."""
        if not path.is_file():
            return 0
        tensors, metadata = load_tensors(path)
        if metadata.get("settings") != _settings_text(self.settings, self.workers.count):
            raise ValueError(f"{path}: the state of a run with other settings; use another output folder or remove it")

        def under(prefix: str) -> dict[str, Tensor]:
            return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}

        self.model.load_state_dict(under("model."))
        self.optimiser.load_state_tensors(under("adam."))
        self.seconds = float(metadata.get("seconds", 0))
        return int(metadata["done"])


def _settings_text(settings: TrainSettings, processes: int) -> str:
    """What must agree for a run to be continued."""
    values = dataclasses.asdict(settings)
    for free in ("save_every", "log_every", "cache_mb"):
        del values[free]
    return json.dumps({**values, "processes": processes}, sort_keys=True)


def train(
    settings: TrainSettings,
    samples: LabelledFrames,
    out: str | Path,
    device: str = "cpu",
    progress: Callable[[TrainProgress], None] | None = None,
) -> Path:
    """Train a detector; returns out/model.safetensors (its card is out/model.json).

    samples  len() and samples[i] -> (PointFrame, list of KittiObject)
    out      also holds state.safetensors (a run started again continues from it) and log.csv
    Under torchrun every process calls this with the same arguments; rank 0 writes.
    Raises ValueError for an empty source, a state of other settings, or a loss that is not finite.
    """
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(settings, samples, device)
    state = folder / "state.safetensors"
    done = trainer.resume(state)
    is_first = trainer.workers.rank == 0
    log = TrainingLog(folder, done) if is_first else None
    sums: dict[str, float] = {}
    started = last = time.perf_counter()
    for step in range(done, settings.steps):
        for name, value in trainer.step(step).items():
            sums[name] = sums.get(name, 0.0) + value
        number = step + 1
        if number % settings.log_every == 0 or number == settings.steps:
            count = (number - 1) % settings.log_every + 1
            count = min(count, number - done)
            means = {name: value / count for name, value in sums.items()}
            now = time.perf_counter()
            if log is not None:
                rate = (now - started) / (number - done)
                log.write(number, {**means, "seconds_per_step": (now - last) / count})
                if progress is not None:
                    epoch = step // trainer.epoch_steps
                    progress(
                        TrainProgress(number, settings.steps, epoch, means, rate, rate * (settings.steps - number))
                    )
            sums, last = {}, now
        if is_first and (number % settings.save_every == 0 or number == settings.steps):
            trainer.save(state, number)
    facts = {
        "steps": settings.steps,
        "seed": settings.seed,
        "frames": len(samples),
        "hours": round(trainer.spent / 3600, 3),
        "training": json.loads(_settings_text(settings, trainer.workers.count)),
        "versions": {"torch": torch.__version__, "numpy": np.__version__},
    }
    path = folder / "model.safetensors"
    return save_checkpoint(trainer.model, trainer.preset, path, facts) if is_first else path


def _train_worker(rank: int, count: int, port: int, arguments: tuple[Any, ...]) -> None:
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(count), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    torch.set_num_threads(1)
    settings, samples, out, progress = arguments
    end_with_parent()
    try:
        train(settings, samples, out, progress=progress)
    finally:
        if dist.is_initialized():
            dist.destroy_process_group()


def train_in_processes(
    settings: TrainSettings,
    samples: LabelledFrames,
    out: str | Path,
    processes: int,
    progress: Callable[[TrainProgress], None] | None = None,
) -> Path:
    """`train` on the CPU in several one-thread processes with averaged gradients (2 such beat one with two threads).

    samples and progress are sent to the processes and must be picklable; progress is called in the first of them.
    settings.batch_size counts per process.
    """
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    torch.multiprocessing.spawn(
        _train_worker, args=(processes, port, (settings, samples, out, progress)), nprocs=processes
    )
    return Path(out) / "model.safetensors"
