"""The train stage: frames of a data set as samples of the libraries' own training loops; weights in OUT/weights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.config import Config
from pipeline.data import Dataset
from pipeline.errors import DataError, UsageError
from pipeline.frame_files import FrameFiles
from pipeline.paths import RunFolder
from pipeline.settings import plain, with_changes
from pipeline.stages import cloud_of, open_frames
from pipeline.versions import made_with

if TYPE_CHECKING:
    from completion.types import DepthFrame
    from detection.kitti_format import KittiObject
    from detection.types import PointFrame


@dataclass(frozen=True)
class DepthSamples:
    """Frames with true depth, as `completion.train` reads them; picklable for its worker processes."""

    dataset: Dataset

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int, /) -> DepthFrame:
        from completion.types import DepthFrame

        frame = self.dataset[index]
        camera = frame.calibration.K if frame.has("calibration") else None
        return DepthFrame(frame.image, frame.sparse_depth, frame.target_depth, camera)


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
        points = cloud_of(self.config, frame, FrameFiles(self.run, frame.id))
        camera = frame.calibration
        return PointFrame(points, camera.T_cam_velo, camera.P2, frame.image_size, frame.id), frame.labels


def train_stage(config: Config, run: RunFolder) -> Path:
    """Trains, or continues to train, the network of the configuration; returns its weights."""
    dataset = open_frames(config, run)
    out = run.weights / config.train.network
    print(f"training the {config.train.network} network on {len(dataset)} frames; state, log and weights: {out}")
    try:
        if config.train.network == "completion":
            return train_completion(config, dataset, out)
        return train_detection(config, CloudSamples(dataset, config, run), out)
    except DataError:
        raise
    except ValueError as error:
        raise UsageError(f"train: {error}") from None


def train_completion(config: Config, dataset: Dataset, out: Path) -> Path:
    """`completion.train` on frames with true depth; the run's seed unless the section has its own."""
    from completion.models import default_spec
    from completion.train import TrainSettings, train

    if not dataset[0].has("target_depth"):
        raise UsageError(f"{dataset.root}: frame {dataset.ids[0]} has no true depth to train completion on")
    changes = config.train.library
    # Another architecture brings its own input scaling, which single keys may still change.
    architecture = str(changes.get("model", {}).get("architecture", "twise"))
    base = TrainSettings(default_spec(architecture), seed=config.seed)
    settings = with_changes(base, changes, "train")
    return train(settings, DepthSamples(dataset), out, facts=training_facts(config))


def train_detection(config: Config, samples: CloudSamples, out: Path) -> Path:
    """`detection.train` on labelled clouds."""
    from detection.train import TrainSettings, train

    if not samples.dataset[0].has("labels"):
        raise UsageError(f"{samples.dataset.root}: frame {samples.dataset.ids[0]} has no label to train detection on")
    settings = with_changes(TrainSettings(seed=config.seed), config.train.library, "train")

    def report(progress: Any) -> None:
        losses = "  ".join(f"{name} {value:.3f}" for name, value in progress.losses.items())
        print(f"step {progress.step} of {progress.steps}  {losses}", flush=True)

    return train(settings, samples, out, config.detection.device, report)


def training_facts(config: Config) -> dict[str, Any]:
    """What goes into the card of the weights."""
    return {"data": plain(config.data.model_dump()), "synth": plain(config.synth.library), "made_with": made_with()}
