"""What the train section of a configuration asks for: the settings of the library that trains the network."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from auglidar_base.errors import CheckpointError, SettingsError
from pipeline.base.errors import UsageError
from pipeline.base.settings import with_changes
from pipeline.run_folder.config import Config
from pipeline.run_folder.resolved import with_every_field

if TYPE_CHECKING:
    from completion.train import TrainSettings as CompletionSettings
    from detection.train import TrainSettings as DetectionSettings
    from pipeline.semantics.training import SegmentationSettings


def completion_settings(config: Config) -> CompletionSettings:
    """Of `completion.train`; the run's seed unless the section has its own, the network of `warm_start` unless it names
    a model."""
    from completion.checkpoints import load_checkpoint
    from completion.models import default_spec
    from completion.train import TrainSettings
    from completion.training_loss import LossSettings, default_kind

    changes = config.train.library
    # Another architecture brings its own input scaling, which single keys may still change.
    model, start = changes.get("model"), changes.get("warm_start")
    architecture = str(model.get("architecture", "twise")) if isinstance(model, Mapping) else "twise"
    try:
        spec = default_spec(architecture) if model or not start else load_checkpoint(str(start))[1].model
    except SettingsError as error:
        raise UsageError(f"train.model: {error}") from None
    except CheckpointError as error:
        raise UsageError(f"train: {error}") from None
    base = TrainSettings(spec, LossSettings(default_kind(spec)), seed=config.seed)
    return with_changes(base, changes, "train")


def detection_settings(config: Config) -> DetectionSettings:
    """Of `detection.train`; the detection section's device unless the section has its own."""
    from detection.train import TrainSettings

    return with_changes(TrainSettings(seed=config.seed, device=config.detection.device), config.train.library, "train")


def segmentation_settings(config: Config) -> SegmentationSettings:
    """Of `pipeline.semantics.training`."""
    from pipeline.semantics.training import SegmentationSettings

    return with_changes(SegmentationSettings(seed=config.seed), config.train.library, "train")


SETTINGS: Mapping[str, Callable[[Config], Any]] = {
    "completion": completion_settings,
    "detection": detection_settings,
    "segmentation": segmentation_settings,
}


def with_training_settings(config: Config) -> Config:
    """The configuration with every field of the training listed. Raises UsageError for an unknown field or value."""
    settings = SETTINGS[config.train.network](config)
    return config.model_copy(update={"train": with_every_field(config.train, settings)})
