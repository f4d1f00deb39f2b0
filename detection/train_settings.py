"""The settings of a detector's training run."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from auglidar_base.devices import check_device
from auglidar_base.errors import SettingsError
from detection.data_augmentation import PasteSettings, SceneAugmentation
from detection.optimiser import OneCycleSettings


@dataclass(frozen=True)
class TrainSettings:
    """One training run.

    steps            updates of the weights in all, over which the schedule runs
    batch_size       frames of one update, per process
    learning_rate    largest of the schedule
    save_every       steps between saved states and last checkpoints
    validate_every   steps between validations; 0: only at the end
    device           "auto", "cpu", "cuda", "cuda:N" or "mps"
    seed             of everything random
    warm_start       weights (a path or a bundled name) to begin with: of the same network or of its first stage alone;
                     input channels they lack start at zero, classes as a copy of similar ones
    preset           the detector: a name in `detection.models.presets.PRESETS`, built with `options`
    options          arguments of the preset
    optimiser        shape of the one-cycle schedule
    scene            scene augmentation, or None (the thesis uses none)
    paste            ground truth sampling, or None
    paste_frames     frames, drawn at the start, whose objects are pasted
    validation_frames  frames of a validation, at most
    best_by          the validation figure that chooses the best checkpoint, higher is better
    log_every        steps between rows of log.csv
    cache_mb         megabytes for the visible points of frames, read once then instead of once per epoch
    """

    RENAMED: ClassVar[Mapping[str, str]] = {"optimiser.peak": "learning_rate"}

    steps: int = 20000
    batch_size: int = 2
    learning_rate: float = 0.002
    save_every: int = 500
    validate_every: int = 0
    device: str = "cpu"
    seed: int = 0
    warm_start: str | None = None
    preset: str = "small"
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    optimiser: OneCycleSettings = dataclasses.field(default_factory=OneCycleSettings)
    scene: SceneAugmentation | None = dataclasses.field(default_factory=SceneAugmentation)
    paste: PasteSettings | None = None
    paste_frames: int = 200
    validation_frames: int = 50
    best_by: str = "ap_3d"
    log_every: int = 20
    cache_mb: int = 1500

    def __post_init__(self) -> None:
        check_device(self.device)
        for name in ("steps", "batch_size", "learning_rate", "save_every", "log_every"):
            if not getattr(self, name) > 0:
                raise SettingsError(f"{name}: expected a value > 0, got {getattr(self, name)}")

    def identity(self, processes: int) -> str:
        """JSON of everything that determines the weights; a run resumes only under the same one."""
        values = dataclasses.asdict(self)
        for free in ("save_every", "validate_every", "validation_frames", "best_by", "log_every", "cache_mb", "device"):
            del values[free]
        return json.dumps({**values, "processes": processes}, sort_keys=True)
