"""The train stage: frames of a data set as samples of the libraries' own training loops; weights in OUT/weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np

from auglidar_base.errors import CheckpointError, SettingsError
from auglidar_base.progress import TrainProgress
from pipeline.base.errors import DataError, UsageError
from pipeline.base.paths import RunFolder
from pipeline.base.progress import duration
from pipeline.base.settings import plain
from pipeline.base.versions import made_with
from pipeline.data import Dataset, Frame, open_dataset
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.frames import open_frames
from pipeline.run_folder.preset import uses_raw_lidar
from pipeline.stages.clouds import cloud_of
from pipeline.training.beam_subsampling import RandomBeamSubsampling
from pipeline.training.rehearsal import Rehearsal
from pipeline.training.ring_samples import RingSamples, held_out_validation
from pipeline.training.settings import completion_settings, detection_settings, segmentation_settings
from pipeline.training.varied_streets import VariedStreets

if TYPE_CHECKING:
    from completion.samples import SampleSource, TrainingSample
    from completion.types import DepthFrame
    from detection.kitti_format import KittiObject
    from detection.train import LabelledFrames
    from detection.types import PointFrame

T = TypeVar("T")


def of_frame(frame: Frame, make: Callable[..., T], *parts: Any) -> T:
    """`make(*parts)`; what it refuses (sizes that differ, NaN) is a fault of the frame. Raises DataError."""
    try:
        return make(*parts)
    except ValueError as error:
        raise DataError(frame.id, "a frame to train on", str(error)) from None


@dataclass(frozen=True)
class DepthSamples:
    """Frames with true depth, as `completion.train` reads them; picklable for its worker processes."""

    dataset: Dataset
    beam_strides: tuple[int, ...] = ()
    calibration_jitter: float = 0.0

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int, /) -> DepthFrame | TrainingSample:
        from completion.samples import TrainingSample
        from completion.types import DepthFrame

        frame = self.dataset[index]
        camera = frame.calibration.K if frame.has("calibration") else None
        sample = of_frame(frame, DepthFrame, frame.image, frame.sparse_depth, frame.target_depth, camera)
        if not self.beam_strides:
            return sample
        return TrainingSample(sample, RandomBeamSubsampling.of(frame, self.beam_strides, self.calibration_jitter))


@dataclass(frozen=True)
class CloudSamples:
    """Labelled clouds (raw LiDAR, or the run's augmented clouds), as `detection.train` reads them."""

    dataset: Dataset
    config: Config
    run: RunFolder

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int, /) -> tuple[PointFrame, list[KittiObject]]:
        from detection.types import PointFrame

        frame = self.dataset[index]
        points = cloud_of(uses_raw_lidar(self.config), frame, FrameOutputs(self.run, frame.id))
        camera = frame.calibration
        size = frame.image_size
        return of_frame(frame, PointFrame, points, camera.T_cam_velo, camera.P2, size, frame.id), frame.labels


@dataclass(frozen=True)
class MaskSamples:
    """Frames with class maps, as `pipeline.semantics.training` reads them."""

    dataset: Dataset

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int, /) -> Frame:
        return self.dataset[index]


def cloud_samples(dataset: Dataset, config: Config, run: RunFolder) -> LabelledFrames:
    """The run's clouds, or with `train.beam_strides` clouds of so many rows made for training alone."""
    if not config.train.beam_strides:
        return CloudSamples(dataset, config, run)
    from pipeline.training.thinned_clouds import ThinnedClouds

    return ThinnedClouds(dataset, config, run)


def train_stage(config: Config, run: RunFolder) -> Path:
    """Trains, or continues to train, the network of the configuration; returns its weights."""
    dataset = open_frames(config, run)
    out = run.weights / config.train.network
    print(f"training the {config.train.network} network on {len(dataset)} frames; state, log and weights: {out}")
    try:
        if config.train.network == "completion":
            return train_completion(config, dataset, out)
        if config.train.network == "segmentation":
            return train_segmentation(config, dataset, out)
        if not dataset[0].has("labels"):
            raise UsageError(f"{dataset.root}: frame {dataset.ids[0]} has no label to train detection on")
        return train_detection(config, dataset, run, out)
    except (SettingsError, CheckpointError) as error:
        raise UsageError(f"train: {error}") from None


def train_completion(config: Config, dataset: Dataset, out: Path) -> Path:
    """`completion.train` on frames with true depth; the run's seed unless the section has its own."""
    from completion.train import train

    settings = completion_settings(config)
    if config.train.truth != "held_out_rings":
        require_depth(dataset, "; train.truth=held_out_rings learns from the scans themselves")
    dataset, held_back = split(dataset, settings)
    samples = completion_samples(dataset, config)
    validation = [_validation_frame(held_back[frame_id], config) for frame_id in held_back.ids]
    facts = training_facts(config)
    return train(settings, samples, out, validation=validation, facts=facts, progress=print_progress)


def require_depth(dataset: Dataset, hint: str = "") -> None:
    """Raises UsageError when the first frame has no true depth."""
    if not dataset[0].has("target_depth"):
        raise UsageError(f"{dataset.root}: frame {dataset.ids[0]} has no true depth to train completion on{hint}")


def completion_samples(dataset: Dataset, config: Config) -> SampleSource:
    """The frames with what `train.truth` says is their truth, and those of `train.rehearse` between them."""
    section = config.train
    samples: SampleSource
    if section.truth == "both" or section.photographs or section.relief:
        samples = VariedStreets.of(dataset, section)
    else:
        kind = RingSamples if section.truth == "held_out_rings" else DepthSamples
        samples = kind(dataset, section.beam_strides, section.calibration_jitter)
    if section.rehearse is None:
        return samples
    other = open_dataset("kitti_object", section.rehearse)
    require_depth(other, " (train.rehearse)")
    every = (1, *section.beam_strides) if section.beam_strides else ()
    return Rehearsal(samples, DepthSamples(other, every, section.calibration_jitter))


class Validated(Protocol):
    """What the settings of the three trainers say about validation."""

    @property
    def validate_every(self) -> int: ...

    @property
    def validation_frames(self) -> int: ...


def split(dataset: Dataset, settings: Validated) -> tuple[Dataset, Dataset]:
    """(frames to train on, frames to validate on): the last `validation_frames`, at most a tenth, are held back.

    None are without `validate_every`.
    """
    held_back = min(settings.validation_frames, len(dataset) // 10) if settings.validate_every else 0
    count = len(dataset) - held_back
    return dataset.select(dataset.ids[:count]), dataset.select(dataset.ids[count:])


def _validation_frame(frame: Frame, config: Config) -> DepthFrame:
    """A held-back frame; with `beam_strides`, at 16 rows of 64 and without jitter, so that figures of runs compare."""
    from completion.types import DepthFrame

    if config.train.truth == "held_out_rings":
        return held_out_validation(frame, config.train.beam_strides)
    sparse = (
        RandomBeamSubsampling.of(frame, (4,), 0.0)(np.random.default_rng(0))
        if config.train.beam_strides
        else frame.sparse_depth
    )
    return of_frame(frame, DepthFrame, frame.image, sparse, frame.target_depth)


def train_detection(config: Config, dataset: Dataset, run: RunFolder, out: Path) -> Path:
    """`detection.train` on labelled clouds; with `beam_strides`, held-back frames are seen at 16 rows of 64."""
    from detection.train import train

    settings = detection_settings(config)
    dataset, held_back = split(dataset, settings)
    thinned = config.train.model_copy(update={"beam_strides": (4,) if config.train.beam_strides else ()})
    validation = cloud_samples(held_back, config.model_copy(update={"train": thinned}), run)
    return train(settings, cloud_samples(dataset, config, run), out, validation, print_progress)


def train_segmentation(config: Config, dataset: Dataset, out: Path) -> Path:
    """`pipeline.semantics.training.train_segmenter` on frames with class maps."""
    from pipeline.semantics.training import train_segmenter

    if not dataset[0].has("semantics"):
        raise UsageError(f"{dataset.root}: frame {dataset.ids[0]} has no class map to train segmentation on")
    settings = segmentation_settings(config)
    dataset, held_back = split(dataset, settings)
    samples: Any = MaskSamples(dataset)
    validation: Any = MaskSamples(held_back)
    return train_segmenter(settings, samples, out, validation, print_progress)


def print_progress(progress: TrainProgress) -> None:
    """A line with the losses and the time that is left."""
    losses = "  ".join(f"{name} {value:.3g}" for name, value in progress.losses.items())
    left = f"  about {duration(progress.eta)} left" if progress.step < progress.steps else ""
    print(f"step {progress.step} of {progress.steps}  {losses}{left}", flush=True)


def training_facts(config: Config) -> dict[str, Any]:
    """What goes into the card of the weights."""
    return {"data": plain(config.data.model_dump()), "synth": plain(config.synth.library), "made_with": made_with()}
