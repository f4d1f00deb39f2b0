"""What a named detector is made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from torch import nn

from detection.inputs import InputSettings


@dataclass(frozen=True)
class OutputSettings:
    """From refined boxes to detections.

    score_threshold  on the sigmoid of the score
    nms_iou          rotated BEV IoU above which the lower score is suppressed
    nms_per_class    only within a class; else over all boxes (OpenPCDet)
    limit            detections kept by each suppression; None for all
    probability      detections carry the sigmoid; else the raw logit, as the reference's result files do
    mirrored_pass    detect on the mirrored cloud as well and pool the boxes
    vote_iou         boxes of a class that overlap a kept one by more are averaged with it by score; 1 = no voting
    """

    score_threshold: float
    nms_iou: float = 0.1
    probability: bool = False
    mirrored_pass: bool = False
    vote_iou: float = 1.0
    nms_per_class: bool = True
    limit: int | None = None


@dataclass(frozen=True)
class Preset:
    """A detector by name.

    options  arguments that rebuild it: PRESETS[name](**options)
    skip_empty_frames  training leaves out frames without a box of the classes, as PointRCNN does
    norm_schedule      training follows PointRCNN's momentum of the batch normalisations; else they keep their own
    """

    name: str
    classes: tuple[str, ...]
    inputs: InputSettings
    outputs: OutputSettings
    build: Callable[[], nn.Module]
    options: dict[str, Any] = field(default_factory=dict)
    skip_empty_frames: bool = True
    norm_schedule: bool = True
