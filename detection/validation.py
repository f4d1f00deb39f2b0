"""How good a detector is on held-out frames while it is trained."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from detection.evaluation.kitti_ap import evaluate
from detection.infer import Detector
from detection.models.presets import Preset
from detection.results import result_objects
from detection.train_settings import TrainSettings
from detection.training_batches import LabelledFrames

_SCORED = ("Car", "Pedestrian", "Cyclist")


def validation_figures(
    model: nn.Module, preset: Preset, device: torch.device, frames: LabelledFrames, settings: TrainSettings
) -> dict[str, float]:
    """KITTI AP (3D, strict IoU, 40 recall points, moderate; percent): "ap_3d_car", ..., and their mean "ap_3d".

    Classes without an object among the frames do not count; a class with objects and without detections has 0.
    The network is left in evaluation mode.
    """
    detector = Detector(model.eval(), preset, device, settings.seed)
    labels, found = [], []
    for index in range(min(len(frames), settings.validation_frames)):
        frame, objects = frames[index]
        labels.append(objects)
        found.append(result_objects(detector.detect(frame), frame))
    classes = [name for name in preset.classes if name in _SCORED] or list(preset.classes)
    report = evaluate(labels, found, classes=classes, metrics=("3d",), iou_set="strict")
    rows = [row for row in report["results"] if row["n_gt"][1]]
    figures = {f"ap_3d_{row['class'].lower()}": float(row["moderate"] or 0.0) for row in rows}
    return {"ap_3d": float(np.mean(list(figures.values()))) if figures else 0.0, **figures}
