"""How large and how long a detection experiment is: smoke (tests), small (this project's results), paper (GPU)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

# Where the seconds below were measured; another machine needs another time, not other results.
MACHINE = "one core of a 2-core AMD EPYC server (AVX2), torch 2.13, process time"

DEFAULT_DETECTOR = "PointRCNN2"


@dataclass(frozen=True)
class DetectorChoice:
    """The network that stands for a detector of the thesis at a budget.

    preset, options   `detection.models.presets.PRESETS[preset](**options)`; the point features are added
    features          point columns beside x y z before those that an input adds (source, semantic)
    dense             name of an option that is True for completed depth and False for raw LiDAR; "" for none
    start_steps       updates of the network that every row begins with (`common_pretraining.py`); 0: random weights, as
                      published. Detectors have about the same time for it, not the same steps
    seconds_per_step  of two clouds; seconds_per_frame of detection; measured on MACHINE, except those of budget
                      paper, which are extrapolated from one forward pass (docs/detection.md)
    first_stage       detector whose start this one's start begins with, as its first stage; "": random weights
    """

    preset: str
    options: Mapping[str, Any] = field(default_factory=dict)
    features: tuple[str, ...] = ()
    dense: str = ""
    start_steps: int = 0
    seconds_per_step: float = 0.4
    seconds_per_frame: float = 0.38
    first_stage: str = ""


@dataclass(frozen=True)
class DetectionBudget:
    """Data, training and test of every detection run.

    train_frames, test_frames   frames; size (height, width) of synthetic images, None for KITTI's own
    steps, batch   updates and clouds of each; peak of the one-cycle learning rate
    augmented      scene augmentation (flip, turn, scale); the thesis uses none (5.4.4)
    cloud_points   most points of a stored cloud; the thesis draws 50k of dense depth
    detectors      networks by the thesis' names
    completer      network of the completed depth: a bundled name or a path of weights
    masks          where object masks come from, as `augment.semantics`
    resamples      of the bootstrap over test frames
    """

    train_frames: int
    test_frames: int
    size: tuple[int, int] | None
    steps: int
    batch: int
    peak: float
    augmented: bool
    cloud_points: int
    detectors: Mapping[str, DetectorChoice]
    completer: str = "selection_small"
    masks: str = "truth"
    resamples: int = 300
    seconds_per_data_frame: float = 2.5

    def part_for(self, settings: Mapping[str, Any]) -> DetectionBudget:
        """The budget with the detectors alone that a run trains; unchanged for a detector it does not know."""
        needed, name = {}, str(settings.get("detector", DEFAULT_DETECTOR))
        while name in self.detectors and name not in needed:
            needed[name] = self.detectors[name]
            name = needed[name].first_stage
        return replace(self, detectors=needed) if needed else self


_POINT = ("height", "range")
_RAW = ("intensity",)


def _small(points: int, width: float, start: int, seconds: float) -> DetectorChoice:
    return DetectorChoice("small", {"points": points, "width": width, "classes": ["Car"]}, _POINT, "", start, seconds)


def _voxel(preset: str, cell: float, start: int, seconds: float, first_stage: str = "") -> DetectorChoice:
    return DetectorChoice(preset, {"cell": cell, "classes": ["Car"]}, _RAW, "", start, seconds, 0.5, first_stage)


_TINY = _small(512, 0.1, 2, 0.15)
_SMALL = {
    "PointRCNN2": _small(4096, 0.5, 2000, 0.37),
    "PointPillars": _voxel("pointpillars_small", 0.64, 1000, 0.51),
    "SECOND": _voxel("second_small", 0.2, 1200, 0.67),
    "Voxel-RCNN": _voxel("voxel_rcnn_small", 0.2, 350, 1.05, "SECOND"),
    "PV-RCNN": _voxel("pv_rcnn_small", 0.2, 250, 1.37, "SECOND"),
}
_SMOKE = {
    "PointRCNN2": _TINY,
    "PointPillars": _voxel("pointpillars_small", 2.56, 2, 0.17),
    "SECOND": _voxel("second_small", 0.8, 2, 0.5),
    "Voxel-RCNN": _voxel("voxel_rcnn_small", 0.8, 2, 0.81, "SECOND"),
    "PV-RCNN": _voxel("pv_rcnn_small", 0.8, 2, 1.27, "SECOND"),
}
_PAPER = {
    "PointRCNN": DetectorChoice("pointrcnn", seconds_per_step=10, seconds_per_frame=1.6),
    "PointRCNN2": DetectorChoice("thesis", {}, (), "dense", seconds_per_step=15, seconds_per_frame=2.5),
    "PointPillars": DetectorChoice("pointpillars", {}, _RAW, "", 0, 12, 3),
    "SECOND": DetectorChoice("second", {}, _RAW, "", 0, 12, 3),
    "Voxel-RCNN": DetectorChoice("voxel_rcnn", {}, _RAW, "", 0, 15, 3),
    "PV-RCNN": DetectorChoice("pv_rcnn", {}, _RAW, "", 0, 25, 5),
}

DETECTION: dict[str, DetectionBudget] = {
    "smoke": DetectionBudget(2, 2, (96, 320), 2, 1, 0.004, False, 3000, _SMOKE, resamples=10),
    "small": DetectionBudget(160, 80, None, 150, 2, 0.004, True, 30_000, _SMALL),
    # 50 epochs of two clouds, no augmentation (thesis 5.4.4).
    "paper": DetectionBudget(3712, 3769, None, 92_800, 2, 0.002, False, 50_000, _PAPER, resamples=1000),
}
