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

from auglidar_base.errors import CheckpointError
from detection.boxes import wrap_angle
from detection.checkpoints import import_checkpoint, load_checkpoint
from detection.inputs import CameraCloud, camera_cloud, ground_height, lidar_input, mirrored, network_input
from detection.lidar_inputs import all_points, from_camera_axes
from detection.models.batch import DetectorModel, PointBatch, RawDetections
from detection.models.openpcdet_pointrcnn import to_camera_axes
from detection.models.presets import IMPORTED_PRESETS, OutputSettings, Preset
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
        Raises SettingsError when the frame lacks a column the network was trained with.
        """
        if self.preset.inputs.frame == "lidar":
            return self._detect_in_lidar_frame(frame)
        cloud = camera_cloud(frame)
        if not len(cloud.xyz):
            return Detections.empty()
        found = [self._pass(cloud, frame.id, "straight")]
        if self.preset.outputs.mirrored_pass:
            found.append(_mirror_back(self._pass(mirrored(cloud), frame.id, "mirrored")))
        return final_detections(found, self.preset.outputs, self.preset.classes)

    def _generator(self, frame_id: str, name: str) -> np.random.Generator:
        digest = hashlib.sha256(f"{frame_id}/{name}".encode()).digest()
        return np.random.default_rng([self.seed, int.from_bytes(digest[:8], "little")])

    def _pass(self, cloud: CameraCloud, frame_id: str, name: str) -> RawDetections:
        rng = self._generator(frame_id, name)
        points, full = network_input(cloud, ground_height(cloud.xyz), self.preset.inputs, rng)
        return self._run(points, full)

    def _run(self, points: NDArray[np.float32], full: NDArray[np.float32]) -> RawDetections:
        def on_device(values: NDArray[Any]) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)

        batch = PointBatch(on_device(points)[None], [on_device(full)], [], [])
        with torch.inference_mode():
            return cast(DetectorModel, self.model).raw_detections(batch)[0]

    def _detect_in_lidar_frame(self, frame: PointFrame) -> Detections:
        inputs = self.preset.inputs
        if inputs.sampler == "all":
            full = all_points(frame, inputs.features)
            points = full[:0]
        else:
            points = lidar_input(frame, inputs.points, self._generator(frame.id, "straight"))
            full = points[:0]
        if not len(points) + len(full):
            return Detections.empty()
        raw = self._run(points, full)
        # The last suppression looks at boxes from above in the LiDAR frame, where the network found them.
        turned = RawDetections(to_camera_axes(raw.boxes), raw.logits, raw.classes)
        found = final_detections([turned], self.preset.outputs, self.preset.classes)
        return Detections(from_camera_axes(found.boxes.values, frame), found.classes, found.scores)


def load_detector(path_or_name: str | Path, device: str = "cpu", seed: int = 0) -> Detector:
    """A detector from our own weights: a .safetensors file with its card, or the name of bundled weights.

    Raises CheckpointError saying what is wrong with the file, or which names there are.
    """
    model, preset, _ = load_checkpoint(path_or_name, device)
    return Detector(model, preset, torch.device(device), seed)


def imported_detector(path: str | Path, architecture: str, device: str = "cpu", seed: int = 0) -> Detector:
    """A detector from a public checkpoint; architectures as `detection.checkpoints.import_checkpoint`.

    Raises CheckpointError when the file does not fit, or the architecture has no detector here.
    """
    model = import_checkpoint(path, architecture)
    if architecture not in IMPORTED_PRESETS:
        raise CheckpointError(f"no detector for {architecture!r}; there are {', '.join(IMPORTED_PRESETS)}")
    preset = IMPORTED_PRESETS[architecture](model)
    return Detector(model.to(torch.device(device)), preset, torch.device(device), seed)


def _mirror_back(raw: RawDetections) -> RawDetections:
    """Boxes found in a cloud with x reversed, in the original scene."""
    x, *rest, ry = raw.boxes.unbind(1)
    return RawDetections(torch.stack([-x, *rest, torch.pi - ry], dim=1), raw.logits, raw.classes)


def final_detections(found: list[RawDetections], settings: OutputSettings, classes: tuple[str, ...]) -> Detections:
    """Threshold, rotated NMS and, where asked for, box voting over all passes; best score first."""
    boxes = torch.cat([raw.boxes for raw in found]).double().cpu()
    logits = torch.cat([raw.logits for raw in found]).double().cpu()
    labels = torch.cat([raw.classes for raw in found]).cpu()
    usable = (logits.sigmoid() > settings.score_threshold) & (boxes[:, 3:6] > 0).all(dim=1)
    usable &= torch.isfinite(boxes).all(dim=1)
    boxes, logits, labels = boxes[usable], logits[usable], labels[usable]
    groups = [labels == index for index in range(len(classes))] if settings.nms_per_class else [labels >= 0]
    kept = torch.cat([_kept(boxes, logits, group, settings) for group in groups])
    kept = kept[logits[kept].argsort(descending=True, stable=True)]
    values = boxes[kept].numpy().copy()
    if settings.vote_iou < 1:
        for index in range(len(classes)):
            rows, of_class = (labels[kept] == index).numpy(), labels == index
            values[rows] = vote(boxes[kept][rows], boxes[of_class], logits[of_class].sigmoid(), settings.vote_iou)
    values[:, 6] = wrap_angle(values[:, 6])
    scores = logits[kept].sigmoid() if settings.probability else logits[kept]
    return Detections(Boxes3D(values), tuple(classes[index] for index in labels[kept].tolist()), scores.numpy())


def _kept(boxes: Tensor, logits: Tensor, group: Tensor, settings: OutputSettings) -> Tensor:
    """Indices of the boxes of a group (P,) bool that survive rotated NMS."""
    index = group.nonzero().squeeze(1)
    return index[nms_rotated(boxes[index], logits[index], settings.nms_iou, settings.limit)]


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
