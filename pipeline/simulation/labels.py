"""Exact labels from geometry: 2D and 3D boxes, truncation, occlusion, in KITTI's form.

Amodal masks are drawn triangle by triangle at pixel centres, so they agree with the ray-cast instance map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detection.boxes import observation_angle
from detection.kitti_format import KittiObject
from detection.types import Boxes3D
from pipeline.simulation.scenes.scene import Scene

NEAR_PLANE = 0.15


@dataclass(frozen=True)
class ObjectTruth:
    """What is known about one thing in one view.

    instance        its number in the instance map (1 and up)
    box             (7,) x y z h w l ry, rectified camera 0
    visible_pixels  pixels of the instance map; amodal_pixels: pixels inside the image if nothing hid it
    amodal_bounds   x1 y1 x2 y2 of the whole silhouette, also outside the image, pixels
    truncation      share of the amodal rectangle outside the image, occlusion: share of hidden pixels in the image
    """

    instance: int
    label: str
    box: NDArray[np.float64]
    visible_pixels: int
    amodal_pixels: int
    amodal_bounds: tuple[float, float, float, float]
    truncation: float
    occlusion: float
    speed: float


@njit(cache=True)
def cover(corners: np.ndarray, mask: np.ndarray) -> None:
    """Sets mask[v, u] where the pixel centre (u, v) lies in one of the (F, 3, 2) triangles."""
    height, width = mask.shape
    for f in range(len(corners)):
        ax, ay = corners[f, 0, 0], corners[f, 0, 1]
        bx, by = corners[f, 1, 0], corners[f, 1, 1]
        cx, cy = corners[f, 2, 0], corners[f, 2, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) < 1e-9:
            continue
        u0, u1 = max(0, int(np.ceil(min(ax, bx, cx)))), min(width - 1, int(np.floor(max(ax, bx, cx))))
        v0, v1 = max(0, int(np.ceil(min(ay, by, cy)))), min(height - 1, int(np.floor(max(ay, by, cy))))
        for v in range(v0, v1 + 1):
            for u in range(u0, u1 + 1):
                p = ((bx - ax) * (v - ay) - (by - ay) * (u - ax)) / area
                q = ((cx - bx) * (v - by) - (cy - by) * (u - bx)) / area
                r = ((ax - cx) * (v - cy) - (ay - cy) * (u - cx)) / area
                if p >= 0 and q >= 0 and r >= 0:
                    mask[v, u] = True


def clipped_triangles(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """(F, 3, 3) camera-frame triangles -> those parts in front of the near plane, again as triangles."""
    front = triangles[:, :, 2] > NEAR_PLANE
    whole = front.all(axis=1)
    pieces = [triangles[whole]]
    for triangle in triangles[front.any(axis=1) & ~whole]:
        polygon = []
        for start, end in zip(triangle, np.roll(triangle, -1, axis=0)):
            if start[2] > NEAR_PLANE:
                polygon.append(start)
            if (start[2] > NEAR_PLANE) != (end[2] > NEAR_PLANE):
                share = (NEAR_PLANE - start[2]) / (end[2] - start[2])
                polygon.append(start + share * (end - start))
        pieces += [np.array([[polygon[0], polygon[k], polygon[k + 1]]]) for k in range(1, len(polygon) - 1)]
    return np.concatenate(pieces)


def measure(
    scene: Scene, time: float, P: NDArray[np.float64], T_cam_world: NDArray[np.float64], instances: NDArray[np.int32]
) -> list[ObjectTruth]:
    """The truth of every labelled thing that lies at least partly in front of the camera and in its picture.

    P (3, 4) rectified camera 0 -> pixels; T_cam_world (4, 4); instances (H, W) of that camera
    """
    height, width = instances.shape
    counts = np.bincount(instances.ravel(), minlength=len(scene.objects) + 1)
    result = []
    for index, item in enumerate(scene.objects):
        matrix = T_cam_world @ item.pose(scene.ground, time)
        if not _may_be_seen(matrix, max(item.model.size), P, width):
            continue
        triangles = clipped_triangles(_camera_triangles(scene, index, time, T_cam_world))
        if not len(triangles):
            continue
        homogeneous = triangles @ P[:, :3].T + P[:, 3]
        pixels = homogeneous[..., :2] / homogeneous[..., 2:3]
        low, high = pixels.min(axis=(0, 1)), pixels.max(axis=(0, 1))
        x1, y1, x2, y2 = max(low[0], 0), max(low[1], 0), min(high[0], width - 1), min(high[1], height - 1)
        if x2 <= x1 or y2 <= y1:
            continue
        mask = np.zeros((height, width), dtype=np.bool_)
        cover(pixels, mask)
        amodal, visible = int(mask.sum()), int(counts[index + 1])
        length, wide, tall = item.model.size
        heading = matrix[:3, 0]
        result.append(
            ObjectTruth(
                instance=index + 1,
                label=item.model.label,
                box=np.array([*matrix[:3, 3], tall, wide, length, np.arctan2(-heading[2], heading[0])]),
                visible_pixels=visible,
                amodal_pixels=amodal,
                amodal_bounds=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
                truncation=float(1 - (x2 - x1) * (y2 - y1) / np.prod(high - low)),
                occlusion=float(np.clip(1 - visible / max(amodal, 1), 0, 1)),
                speed=item.speed,
            )
        )
    return result


def _may_be_seen(matrix: NDArray[np.float64], reach: float, P: NDArray[np.float64], width: int) -> bool:
    """A quick test on the centre: in front of the camera and within its horizontal field of view, roughly."""
    x, _, z = matrix[:3, 3]
    return bool(z > -reach and abs(x) < (max(z, 0) + reach) * width / P[0, 0] * 0.75 + reach)


def _camera_triangles(scene: Scene, index: int, time: float, T_cam_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """(F, 3, 3) triangles of one object in the rectified camera frame."""
    parts = [part.moved(T_cam_world) for part in scene.object_parts(index, time)]
    return np.concatenate([part.vertices[part.faces] for part in parts])


def occlusion_level(hidden: float) -> int:
    """KITTI's 0 fully visible, 1 partly, 2 largely occluded, 3 unknown, from the hidden share of the pixels."""
    return int(np.searchsorted([0.2, 0.55, 0.9], hidden, side="right"))


@dataclass(frozen=True)
class LabelRule:
    """Which things get a line of their own, as annotators with image and LiDAR choose them; the rest is DontCare.

    min_height  pixels of the 2D box; min_pixels: visible pixels; min_visible: share of visible pixels
    max_distance metres along the optical axis; max_truncation: share outside the image
    """

    min_height: float = 13.0
    min_pixels: int = 45
    min_visible: float = 0.07
    max_distance: float = 80.0
    max_truncation: float = 0.95


def kitti_labels(truths: list[ObjectTruth], size: tuple[int, int], rule: LabelRule | None = None) -> list[KittiObject]:
    """Label lines of a view of `size` (height, width): objects first, then DontCare regions.

    2D boxes cover the whole silhouette inside the image, hidden parts included. Things nobody can see have no line.
    """
    rule = rule or LabelRule()
    height, width = size
    labels, regions = [], []
    for truth in sorted(truths, key=lambda t: t.box[2]):
        low_x, low_y, high_x, high_y = truth.amodal_bounds
        bbox = (max(low_x, 0.0), max(low_y, 0.0), min(high_x, width - 1.0), min(high_y, height - 1.0))
        clear = bbox[3] - bbox[1] >= rule.min_height and truth.visible_pixels >= rule.min_pixels
        clear &= 1 - truth.occlusion >= rule.min_visible and truth.truncation <= rule.max_truncation
        clear &= truth.box[2] <= rule.max_distance
        if clear:
            labels.append(_label(truth, bbox))
        elif truth.visible_pixels >= 8:
            regions.append(_dont_care(bbox))
    return labels + regions


def _label(truth: ObjectTruth, bbox: tuple[float, float, float, float]) -> KittiObject:
    x, y, z, h, w, l, ry = (float(value) for value in truth.box)
    alpha = float(observation_angle(Boxes3D(truth.box[None]))[0])
    level = occlusion_level(truth.occlusion)
    return KittiObject(truth.label, round(truth.truncation, 2), level, alpha, bbox, (h, w, l), (x, y, z), ry)


def _dont_care(bbox: tuple[float, float, float, float]) -> KittiObject:
    return KittiObject("DontCare", -1, -1, -10.0, bbox, (-1.0, -1.0, -1.0), (-1000.0, -1000.0, -1000.0), -10.0)
