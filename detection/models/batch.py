"""What a detector is given and what it gives back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from torch import Tensor


@dataclass(frozen=True)
class PointBatch:
    """B frames in the rectified camera frame (x right, y down, z forward, metres); voxel detectors: LiDAR frame.

    points   (B, N, 3 + E) sampled points with the model's extra channels
    clouds   B tensors (M_i, 3 + E): all points of each frame, shuffled; the second stage of `small` pools from
             them, voxel detectors see nothing else
    boxes    B tensors (G_i, 7) ground truth x y z h w l ry (LiDAR: x y z centre, l w h, heading); none at test time
    classes  B tensors (G_i,) int64, 1 = first class of the model
    """

    points: Tensor
    clouds: list[Tensor]
    boxes: list[Tensor]
    classes: list[Tensor]


@dataclass(frozen=True)
class RawDetections:
    """Refined boxes of one frame before the last suppression.

    boxes (P, 7) camera form, logits (P,), classes (P,) int64 index into the model's class names
    """

    boxes: Tensor
    logits: Tensor
    classes: Tensor


class DetectorModel(Protocol):
    """What training and inference ask of a network."""

    def training_losses(self, batch: PointBatch, rng: np.random.Generator) -> dict[str, Tensor]:
        """Scalars by name; "loss" is their weighted sum, the others are for the log."""

    def raw_detections(self, batch: PointBatch) -> list[RawDetections]:
        """Refined boxes of each frame."""
