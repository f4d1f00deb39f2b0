"""Detect objects in a point cloud: load a detector by name or file, call `detect` frame by frame."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from detection.boxes import wrap_angle
from detection.checkpoints import load_checkpoint
from detection.inputs import CameraCloud, camera_cloud, ground_height, mirrored, network_input
from detection.models.batch import DetectorModel, PointBatch, RawDetections
from detection.models.presets import OutputSettings, Preset
from detection.ops import iou_bev, nms_rotated
from detection.types import Boxes3D, Detections, PointFrame


@dataclass(frozen=True)
class Detector:
    """A network with its preset on a device.

    seed  with the frame's id it gives the random draw of points, so a frame's detections are always the same
    """

    model: nn.Module
    preset: Preset
    device: torch.device
    seed: int = 0

    def detect(self, frame: PointFrame) -> Detections:
        """Objects of one frame, best score first, boxes in the rectified camera frame.

        Only points inside the image and the detection range count; without any, nothing is found.
        Raises ValueError when the frame lacks a column the network was trained with.
        """
        cloud = camera_cloud(frame)
        if not len(cloud.xyz):
            return Detections.empty()
        found = [self._pass(cloud, frame.id, "straight")]
        if self.preset.outputs.mirrored_pass:
            found.append(_mirror_back(self._pass(mirrored(cloud), frame.id, "mirrored")))
        return final_detections(found, self.preset.outputs, self.preset.classes)

    def _pass(self, cloud: CameraCloud, frame_id: str, name: str) -> RawDetections:
        digest = hashlib.sha256(f"{frame_id}/{name}".encode()).digest()
        rng = np.random.default_rng([self.seed, int.from_bytes(digest[:8], "little")])
        points, full = network_input(cloud, ground_height(cloud.xyz), self.preset.inputs, rng)

        def on_device(values: NDArray[Any]) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)

        batch = PointBatch(on_device(points)[None], [on_device(full)], [], [])
        with torch.inference_mode():
            return cast(DetectorModel, self.model).raw_detections(batch)[0]


def load_detector(path_or_name: str | Path, device: str = "cpu", seed: int = 0) -> Detector:
    """A detector from our own weights: a .safetensors file with its card, or the name of embedded weights.

    Raises ValueError saying what is wrong with the file, or which names there are.
    """
    model, preset, _ = load_checkpoint(path_or_name, device)
    return Detector(model, preset, torch.device(device), seed)


def _mirror_back(raw: RawDetections) -> RawDetections:
    """Boxes found in a cloud with x reversed, in the original scene."""
    x, *rest, ry = raw.boxes.unbind(1)
    return RawDetections(torch.stack([-x, *rest, torch.pi - ry], dim=1), raw.logits, raw.classes)


def final_detections(found: list[RawDetections], settings: OutputSettings, classes: tuple[str, ...]) -> Detections:
    """Threshold, rotated NMS per class and, where asked for, box voting over all passes."""
    boxes = torch.cat([raw.boxes for raw in found]).double().cpu()
    logits = torch.cat([raw.logits for raw in found]).double().cpu()
    labels = torch.cat([raw.classes for raw in found]).cpu()
    usable = (logits.sigmoid() > settings.score_threshold) & (boxes[:, 3:6] > 0).all(dim=1)
    usable &= torch.isfinite(boxes).all(dim=1)
    boxes, logits, labels = boxes[usable], logits[usable], labels[usable]
    parts = []
    for index, name in enumerate(classes):
        of_class = labels == index
        kept, scores = _suppress(boxes[of_class], logits[of_class], settings)
        values = kept.numpy().copy()
        values[:, 6] = wrap_angle(values[:, 6])
        parts.append(Detections(Boxes3D(values), (name,) * len(values), scores.numpy()))
    merged = Detections(
        Boxes3D(np.concatenate([part.boxes.values for part in parts])),
        tuple(name for part in parts for name in part.classes),
        np.concatenate([part.scores for part in parts]),
    )
    return merged.select(np.argsort(-merged.scores, kind="stable"))


def _suppress(boxes: Tensor, logits: Tensor, settings: OutputSettings) -> tuple[Tensor, Tensor]:
    """Kept boxes (K, 7) of one class, voted where asked for, and their scores (K,)."""
    scores = logits.sigmoid() if settings.probability else logits
    if not len(boxes):
        return boxes, scores
    kept = nms_rotated(boxes, logits, settings.nms_iou)
    if settings.vote_iou < 1:
        return vote(boxes[kept], boxes, logits.sigmoid(), settings.vote_iou), scores[kept]
    return boxes[kept], scores[kept]


def vote(kept: Tensor, boxes: Tensor, weights: Tensor, iou: float) -> Tensor:
    """Each kept box (K, 7) averaged with the boxes (P, 7) that overlap it by more than `iou` from above.

    weights  (P,) >= 0, times the overlap. Headings are averaged modulo pi about the kept one (Gidaris and Komodakis
    2015, box voting).
    """
    overlap = torch.as_tensor(iou_bev(kept, boxes)).to(kept)
    share = overlap * (overlap > iou) * weights
    share = share / share.sum(dim=1, keepdim=True).clamp(min=1e-9)
    centre_and_size = share @ boxes[:, :6]
    turn = boxes[None, :, 6] - kept[:, None, 6]
    turn = (turn + torch.pi / 2).remainder(torch.pi) - torch.pi / 2
    ry = kept[:, 6] + (share * turn).sum(dim=1)
    return torch.cat([centre_and_size, ry[:, None]], dim=1)
