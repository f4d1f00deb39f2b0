"""Occlusion and difficulty of Virtual KITTI 2 objects (thesis chapter 5), with the choices it leaves open.

The thesis asks for an occlusion fraction that the data set does not have: `occupancy_ratio` is documented as the
visible fraction, but in every published sample row it is number_pixels / box area: 0.6-0.8 for a car in full view.
Three rules turn the columns into an occlusion o in [0, 1]:

    literal  1 - occupancy_ratio                                     (as documented; nearly no car is then easy)
    fill     1 - occupancy_ratio / f, f = the fill of cars in full view of the same label, scene and variation
    hull     1 - number_pixels / (area of the projected cuboid in the image x its fill in full view)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path

import numpy as np

from detection.boxes import corners
from detection.evaluation.difficulty import Vkitti2Difficulty, occlusion_from_fill
from detection.types import Boxes3D
from pipeline.base.errors import UsageError
from pipeline.data.vkitti2_text import VkittiObject, frame_numbers, objects_of_folder, read_camera_rows, text_folder

RULES = ("fill", "hull", "literal")
LEVELS = ("easy", "medium", "hard", "ignored")
# Boxes that tell what "in full view" looks like: not cut by the image, and large enough for a stable ratio.
_FULL_VIEW_HEIGHT = 40.0
_FULL_VIEW_PERCENTILE = 95
IMAGE_SIZE = (375, 1242)


def difficulty(height: float, truncation: float, occlusion: float) -> str:
    """Level of an object: "easy", "medium", "hard" or "ignored", the easiest whose limits it meets.

    height      bottom - top of the 2D box in pixels
    truncation  truncation_ratio
    occlusion   fraction hidden, by one of the rules above
    The limits, and how the gaps between them are read, are those of the evaluation (`Vkitti2Difficulty`).
    """
    values = (np.array([value]) for value in (height, truncation, occlusion))
    return LEVELS[int(Vkitti2Difficulty().level(*values)[0])]


def occlusion_literal(item: VkittiObject) -> float:
    """1 - occupancy_ratio."""
    return float(np.clip(1 - item.occupancy_ratio, 0, 1))


def occlusion_by_fill(item: VkittiObject, fill: dict[str, float]) -> float:
    """1 - occupancy_ratio / fill of the label in full view (see `full_fill`)."""
    return float(occlusion_from_fill(np.array([item.occupancy_ratio]), fill.get(item.label, 1.0))[0])


def occlusion_by_hull(item: VkittiObject, camera: tuple[float, ...], fill: dict[str, float]) -> float:
    """1 - visible pixels / (projected cuboid area inside the image x fill of the label in full view)."""
    area = hull_area(item, camera) * fill.get(item.label, 1.0)
    return float(np.clip(1 - item.number_pixels / area, 0, 1)) if area > 0 else 1.0


def hull_area(item: VkittiObject, camera: tuple[float, ...]) -> float:
    """Pixels of the projected cuboid (convex hull of its corners, cut to the image); camera = fx fy cx cy."""
    import cv2

    fx, fy, cx, cy = camera
    box = (*item.location, item.height, item.width, item.length, item.ry)
    x, y, z = corners(Boxes3D(np.array([box])))[0].T
    if (z <= 0.1).all():
        return 0.0
    z = np.maximum(z, 0.1)
    pixels = np.column_stack([fx * x / z + cx, fy * y / z + cy])
    hull = cv2.convexHull(pixels.astype(np.float32))
    height, width = IMAGE_SIZE
    frame = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float32)
    area, _ = cv2.intersectConvexConvex(hull, frame)
    return float(area)


def full_fill(folder: Path) -> dict[str, float]:
    """Label -> 95th percentile of occupancy_ratio over untruncated boxes of 40 px and more of a scene and variation."""
    return dict(_full_view(folder, "fill", (folder / "bbox.txt").stat().st_mtime_ns))


def hull_fill(folder: Path) -> dict[str, float]:
    """Label -> 95th percentile of number_pixels / projected cuboid area, over the same boxes."""
    return dict(_full_view(folder, "hull", (folder / "bbox.txt").stat().st_mtime_ns))


@lru_cache(maxsize=12)
def _full_view(folder: Path, rule: str, stamp: int) -> tuple[tuple[str, float], ...]:
    cameras = read_camera_rows(folder / "intrinsic.txt", 4) if rule == "hull" else {}
    ratios: dict[str, list[float]] = {}
    for key, items in objects_of_folder(folder).items():
        for item in items:
            if item.truncation_ratio > 0 or item.height_2d < _FULL_VIEW_HEIGHT:
                continue
            area = hull_area(item, cameras[key]) if rule == "hull" else 0.0
            ratio = item.number_pixels / area if area > 0 else item.occupancy_ratio
            ratios.setdefault(item.label, []).append(ratio)
    return tuple((label, float(np.percentile(values, _FULL_VIEW_PERCENTILE))) for label, values in ratios.items())


def occlusion_rule(folder: Path, rule: str) -> Callable[[VkittiObject], float]:
    """The occlusion function of a rule for the objects of one scene and variation. Raises UsageError if unknown."""
    if rule == "literal":
        return occlusion_literal
    if rule == "fill":
        fill = full_fill(folder)
        return lambda item: occlusion_by_fill(item, fill)
    if rule == "hull":
        fill, cameras = hull_fill(folder), read_camera_rows(folder / "intrinsic.txt", 4)
        return lambda item: occlusion_by_hull(item, cameras[item.frame, item.camera], fill)
    raise UsageError(f"unknown occlusion rule {rule!r}; choose one of {', '.join(RULES)}")


def count_difficulties(
    root: Path, frame_ids: Iterable[str], rule: str, classes: Iterable[str] = ("Car",)
) -> dict[str, int]:
    """Objects per level over the frames of an open Virtual KITTI 2 data set, by one occlusion rule."""
    counts = dict.fromkeys(LEVELS, 0)
    wanted = frozenset(classes)
    rules: dict[Path, Callable[[VkittiObject], float]] = {}
    for frame_id in frame_ids:
        folder = text_folder(root, frame_id)
        if folder not in rules:
            rules[folder] = occlusion_rule(folder, rule)
        for item in objects_of_folder(folder).get(frame_numbers(frame_id), ()):
            if item.label in wanted:
                counts[difficulty(item.height_2d, item.truncation_ratio, rules[folder](item))] += 1
    return counts
