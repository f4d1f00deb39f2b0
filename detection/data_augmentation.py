"""Training augmentation in the camera frame: whole scenes, and objects pasted from other scenes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detection.boxes import wrap_angle
from detection.models.box_coding import rotate_y
from detection.ops import iou_3d

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SceneAugmentation:
    """Scene augmentation of PointRCNN (probabilities 1, 1, 0.5), and what helps from synthetic to real scans.

    rotation  largest angle about the vertical axis, radians       scale  largest relative change of size
    flip      probability of mirroring left and right
    object_scale  largest relative change of each object's height, width and length with its points (0: none), against
                  learning the sizes of the training set by heart (ST3D, Yang et al. 2021: random object scaling)
    noise     standard deviation of every coordinate, metres        drop  largest share of points left out
    """

    rotation: float = math.pi / 18
    scale: float = 0.05
    flip: float = 0.5
    object_scale: float = 0.0
    noise: float = 0.0
    drop: float = 0.0


@dataclass(frozen=True)
class TrainingScene:
    """One frame while it is prepared for training.

    points   (N, 3 + C) float32 camera frame, C columns of the frame       height  (N,) metres above ground
    boxes    (G, 7) float64 camera form                                    classes (G,) int64
    obstacles (K, 7) every labelled object, also of other classes: nothing may be pasted into them
    """

    points: NDArray[np.float32]
    height: NDArray[np.float32]
    boxes: Array
    classes: NDArray[np.int64]
    obstacles: Array


def rotate_about_y(xyz: NDArray[Any], angle: float) -> NDArray[Any]:
    """(N, 3) rotated by R_y(angle): x' = x cos + z sin, z' = -x sin + z cos; headings grow by `angle`."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.stack([xyz[:, 0] * cos + xyz[:, 2] * sin, xyz[:, 1], xyz[:, 2] * cos - xyz[:, 0] * sin], axis=1)


def flip_boxes(boxes: Array) -> Array:
    """(G, 7) boxes mirrored in the plane x = 0: x -> -x, ry -> sign(ry) pi - ry."""
    mirrored = boxes.copy()
    mirrored[:, 0] *= -1
    mirrored[:, 6] = np.where(boxes[:, 6] >= 0, math.pi, -math.pi) - boxes[:, 6]
    return mirrored


def augment_scene(scene: TrainingScene, settings: SceneAugmentation, rng: np.random.Generator) -> TrainingScene:
    """The scene rotated, scaled and perhaps mirrored; heights above ground scale with it."""
    if settings.object_scale:
        scene = scale_objects(scene, settings.object_scale, rng)
    if settings.noise or settings.drop:
        scene = disturb_points(scene, settings.noise, settings.drop, rng)
    angle = rng.uniform(-settings.rotation, settings.rotation)
    scale = rng.uniform(1 - settings.scale, 1 + settings.scale)
    flip = rng.uniform() < settings.flip

    def moved(boxes: Array) -> Array:
        turned = np.column_stack(
            [rotate_about_y(boxes[:, :3], angle) * scale, boxes[:, 3:6] * scale, boxes[:, 6] + angle]
        )
        turned = flip_boxes(turned) if flip else turned
        turned[:, 6] = wrap_angle(turned[:, 6])
        return turned

    points = scene.points.copy()
    points[:, :3] = rotate_about_y(points[:, :3], angle) * scale
    if flip:
        points[:, 0] *= -1
    return TrainingScene(
        points, scene.height * np.float32(scale), moved(scene.boxes), scene.classes, moved(scene.obstacles)
    )


def scale_objects(scene: TrainingScene, largest: float, rng: np.random.Generator) -> TrainingScene:
    """Every labelled object with its points stretched along height, width and length about its bottom centre."""
    points, height, boxes = scene.points.copy(), scene.height.copy(), scene.boxes.copy()
    for box in boxes:
        h, w, l = factors = rng.uniform(1 - largest, 1 + largest, 3)
        inside = np.flatnonzero(inside_box(scene.points, box))
        local = rotate_about_y(points[inside, :3] - box[:3], -box[6]) * np.array([l, h, w])
        points[inside, :3] = rotate_about_y(local, box[6]) + box[:3]
        height[inside] *= np.float32(h)
        box[3:6] *= factors
    return TrainingScene(points, height, boxes, scene.classes, scene.obstacles)


def disturb_points(scene: TrainingScene, noise: float, drop: float, rng: np.random.Generator) -> TrainingScene:
    """Gaussian noise on coordinates, and a random share of up to `drop` of the points left out."""
    kept = rng.random(len(scene.points)) >= rng.uniform(0, drop)
    points = scene.points[kept].copy()
    points[:, :3] += rng.normal(0, noise, (len(points), 3)).astype(np.float32)
    return TrainingScene(points, scene.height[kept], scene.boxes, scene.classes, scene.obstacles)


@dataclass(frozen=True)
class DatabaseObject:
    """An object cut out of a scene: points (N, 3 + C) relative to its bottom centre, their heights, box (7,), class."""

    points: NDArray[np.float32]
    height: NDArray[np.float32]
    box: Array
    class_index: int


@dataclass(frozen=True)
class PasteSettings:
    """Ground truth sampling (PointRCNN).

    objects      fewest and most objects drawn per scene        tries  attempts at most
    hard_share   share drawn from objects with <= 100 points    min_points  fewer are not pasted
    clearance    metres added to width and length for the collision test
    """

    objects: tuple[int, int] = (10, 15)
    tries: int = 100
    hard_share: float = 0.6
    min_points: int = 5
    clearance: float = 0.5


def inside_box(points: NDArray[Any], box: Array, extra_height: float = 0.0) -> NDArray[np.bool_]:
    """(N,) whether points (N, 3+) lie in one box (7,), its top raised by `extra_height` metres."""
    local = rotate_about_y(points[:, :3] - box[:3], -box[6])
    h, w, l = box[3:6]
    level = (local[:, 1] <= 0) & (local[:, 1] >= -h - extra_height)
    return level & (np.abs(local[:, 0]) <= l / 2) & (np.abs(local[:, 2]) <= w / 2)


def cut_objects(scene: TrainingScene, min_points: int = 5) -> list[DatabaseObject]:
    """The labelled objects of a scene with at least `min_points` points."""
    found = []
    for box, class_index in zip(scene.boxes, scene.classes):
        inside = inside_box(scene.points, box)
        if inside.sum() >= min_points:
            points = scene.points[inside].copy()
            points[:, :3] -= box[:3].astype(np.float32)
            found.append(DatabaseObject(points, scene.height[inside], box.copy(), int(class_index)))
    return found


def paste_objects(
    scene: TrainingScene, database: Sequence[DatabaseObject], settings: PasteSettings, rng: np.random.Generator
) -> TrainingScene:
    """The scene with objects of other scenes at their own place, moved onto the local ground, never overlapping.

    The ground under an object is taken from the nearest scene point's height above ground (no road planes needed).
    Scene points inside a pasted box, raised by 2 m, are taken away.
    """
    if not database or not len(scene.points):
        return scene
    few = [item for item in database if len(item.points) <= 100]
    many = [item for item in database if len(item.points) > 100]
    points, height = scene.points, scene.height
    boxes, classes, obstacles = scene.boxes, scene.classes, _enlarged(scene.obstacles, settings.clearance)
    wanted = int(rng.integers(settings.objects[0], settings.objects[1] + 1))
    pasted = 0
    for _ in range(settings.tries):
        if pasted == wanted:
            break
        pool = (few or many) if rng.uniform() < settings.hard_share else (many or few)
        item = pool[int(rng.integers(len(pool)))]
        if len(item.points) < settings.min_points:
            continue
        box = item.box.copy()
        box[1] = _ground_y(scene, box)
        grown = _enlarged(box[None], settings.clearance)
        if len(obstacles) and iou_3d(grown, obstacles).max() >= 1e-8:
            continue
        free = ~inside_box(points, box, extra_height=2.0)
        added = item.points.copy()
        added[:, :3] += box[:3].astype(np.float32)
        points, height = np.concatenate([points[free], added]), np.concatenate([height[free], item.height])
        boxes, classes = np.concatenate([boxes, box[None]]), np.append(classes, item.class_index)
        obstacles = np.concatenate([obstacles, grown])
        pasted += 1
    return TrainingScene(points, height, boxes, classes, obstacles)


def _enlarged(boxes: Array, clearance: float) -> Array:
    grown = boxes.copy()
    grown[:, 4:6] += clearance
    return grown


def _ground_y(scene: TrainingScene, box: Array) -> float:
    """y of the ground under a box: that of the nearest point, plus the point's height above ground."""
    nearest = np.argmin((scene.points[:, 0] - box[0]) ** 2 + (scene.points[:, 2] - box[2]) ** 2)
    return float(scene.points[nearest, 1] + scene.height[nearest])


def augment_regions(
    pooled: Tensor, rois: Tensor, truth: Tensor, rng: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """PointRCNN's augmentation of each training RoI with its pooled points and truth, in scene coordinates.

    pooled  (B, P, S, 3 + C)        rois, truth  (B, P, 7)
    Rotation uniform in (-pi / 18, 0] (one-sided in the reference), scale 1 +- 0.05, mirror x with probability 0.5.
    """
    shape = rois.shape[:2]

    def draw(low: float, high: float) -> Tensor:
        return torch.as_tensor(rng.uniform(low, high, shape)).to(rois)

    angle, scale, flip = -draw(0.0, math.pi / 18), draw(0.95, 1.05), draw(0.0, 1.0) < 0.5

    def moved(boxes: Tensor) -> Tensor:
        centre = rotate_y(boxes[..., :3], angle) * scale.unsqueeze(-1)
        ry = boxes[..., 6] + angle
        mirrored = torch.full_like(ry, math.pi).copysign(ry) - ry
        x = torch.where(flip, -centre[..., 0], centre[..., 0])
        heading = torch.where(flip, mirrored, ry)
        sizes = boxes[..., 3:6] * scale.unsqueeze(-1)
        return torch.cat([x.unsqueeze(-1), centre[..., 1:], sizes, heading.unsqueeze(-1)], dim=-1)

    xyz = rotate_y(pooled[..., :3], angle.unsqueeze(-1)) * scale[..., None, None]
    x = torch.where(flip.unsqueeze(-1), -xyz[..., 0], xyz[..., 0])
    points = torch.cat([x.unsqueeze(-1), xyz[..., 1:], pooled[..., 3:]], dim=-1)
    return points, moved(rois), moved(truth)
