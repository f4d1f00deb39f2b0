"""From labelled frames to the batch of a step: order, augmentation, pasted objects, the network's points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from auglidar_base.errors import SettingsError
from detection.data_augmentation import DatabaseObject, TrainingScene, augment_scene, cut_objects, paste_objects
from detection.inputs import CameraCloud, camera_cloud, ground_height, network_input, truth_boxes
from detection.kitti_format import KittiObject, boxes_of
from detection.lidar_inputs import camera_axes_boxes, camera_axes_cloud, lidar_boxes, lidar_rows
from detection.models.batch import PointBatch
from detection.models.presets import Preset
from detection.train_settings import TrainSettings
from detection.types import PointFrame

# What random numbers are for: a generator derives from (seed, purpose, ...).
ORDER, PASTED, SAMPLES = 1, 2, 3


class LabelledFrames(Protocol):
    """A data source: its length, and frame i with its labels."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> tuple[PointFrame, list[KittiObject]]: ...


def frame_order(step: int, frames: int, settings: TrainSettings, rank: int, workers: int) -> list[int]:
    """Frames of a step for one process: consecutive places of a permutation drawn anew for every epoch."""
    first = (step * workers + rank) * settings.batch_size
    chosen = []
    for place in range(first, first + settings.batch_size):
        epoch, within = divmod(place, frames)
        chosen.append(int(np.random.default_rng([settings.seed, ORDER, epoch]).permutation(frames)[within]))
    return chosen


def training_scene(frame: PointFrame, labels: Sequence[KittiObject], preset: Preset) -> TrainingScene:
    """The visible points, their heights and the boxes of one frame, in the camera frame (or turned LiDAR axes)."""
    truth = truth_boxes(labels, preset.classes)
    obstacles = boxes_of([item for item in labels if item.type != "DontCare" and min(item.size) > 0]).values
    cloud, boxes = camera_cloud(frame), truth.boxes
    if preset.inputs.frame == "lidar":
        cloud = camera_axes_cloud(frame)
        boxes, obstacles = camera_axes_boxes(boxes, frame), camera_axes_boxes(obstacles, frame)
    points = np.concatenate([cloud.xyz, cloud.columns], axis=1)
    return TrainingScene(points, ground_height(cloud.xyz), boxes, truth.classes, obstacles)


def object_database(samples: LabelledFrames, preset: Preset, settings: TrainSettings) -> list[DatabaseObject]:
    """Objects to paste, cut out of `paste_frames` frames drawn by the seed."""
    if settings.paste is None:
        return []
    rng = np.random.default_rng([settings.seed, PASTED])
    chosen = rng.permutation(len(samples))[: settings.paste_frames]
    scenes = (training_scene(*samples[int(index)], preset) for index in chosen)
    return [item for scene in scenes for item in cut_objects(scene, settings.paste.min_points)]


class Scenes:
    """The training scenes of a data source, each made from its files once while `megabytes` of memory last."""

    def __init__(self, samples: LabelledFrames, preset: Preset, megabytes: int) -> None:
        self.samples, self.preset = samples, preset
        self.free = megabytes * 10**6
        self.kept: dict[int, TrainingScene] = {}

    def __getitem__(self, index: int) -> TrainingScene:
        """The scene of a frame, or of the next usable one: with visible points and, where the preset asks, a box."""
        count = len(self.samples)
        for place in range(index, index + count):
            scene = self._scene(place % count)
            if len(scene.points) and (len(scene.boxes) or not self.preset.skip_empty_frames):
                return scene
        raise SettingsError(
            f"training: none of the {count} frames has visible points and an object of {', '.join(self.preset.classes)}"
        )

    def _scene(self, index: int) -> TrainingScene:
        if index in self.kept:
            return self.kept[index]
        scene = training_scene(*self.samples[index], self.preset)
        size = scene.points.nbytes + scene.height.nbytes
        if size <= self.free:
            self.free -= size
            self.kept[index] = scene
        return scene


@dataclass(frozen=True)
class _Prepared:
    points: NDArray[np.float32]
    cloud: NDArray[np.float32]
    boxes: NDArray[np.float64]
    classes: NDArray[np.int64]


def prepare_sample(
    scene: TrainingScene,
    preset: Preset,
    settings: TrainSettings,
    database: Sequence[DatabaseObject],
    rng: np.random.Generator,
) -> _Prepared:
    """Augment a scene and draw the network's points."""
    if settings.paste is not None:
        scene = paste_objects(scene, database, settings.paste, rng)
    if settings.scene is not None:
        scene = augment_scene(scene, settings.scene, rng)
    cloud = CameraCloud(scene.points[:, :3], scene.points[:, 3:])
    if preset.inputs.frame == "lidar":
        rows = rng.permutation(lidar_rows(cloud, scene.height, preset.inputs.features))
        return _Prepared(rows[:0], rows, lidar_boxes(scene.boxes), scene.classes)
    points, full = network_input(cloud, scene.height, preset.inputs, rng)
    return _Prepared(points, full, scene.boxes, scene.classes)


def collate(samples: Sequence[_Prepared], device: torch.device) -> PointBatch:
    """A batch on the device."""

    def on_device(values: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(device)

    return PointBatch(
        points=torch.stack([on_device(item.points) for item in samples]),
        clouds=[on_device(item.cloud) for item in samples],
        boxes=[on_device(item.boxes.astype(np.float32)) for item in samples],
        classes=[on_device(item.classes) for item in samples],
    )
