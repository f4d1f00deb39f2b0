"""Boxes as SVG paths: wireframes in the image, footprints from above."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detection.boxes import corners
from detection.evaluation.explain import FALSE_POSITIVE, MISSED, Explanation
from detection.kitti_format import KittiObject, boxes_of
from pipeline.geometry.calibration import Calibration
from pipeline.report.matches import verdict_text
from pipeline.report.pictures import BirdsEye

# Pairs of corners (order of detection.boxes.corners: bottom face, then top face) that make the twelve edges.
EDGES = (
    [(i, (i + 1) % 4) for i in range(4)] + [(i + 4, (i + 1) % 4 + 4) for i in range(4)] + [(i, i + 4) for i in range(4)]
)
MIN_DEPTH = 0.3
DRAWN = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")


@dataclass(frozen=True)
class DrawnBox:
    """One object: SVG path data in image pixels and in bird's-eye pixels, and the text shown when pointed at.

    corners  (8, 3) metres, LiDAR frame, bottom face first
    status   what became of it: "matched", "missed", "false positive", "ignored", or "" where nothing was compared
    met      of a label that was found: the score of the detection that found it
    place    (x, y) pixels of the top left corner of the wireframe in the image, for its name
    """

    kind: str
    image_path: str
    bev_path: str
    title: str
    score: float | None
    corners: NDArray[np.float64]
    status: str = ""
    met: float | None = None
    place: tuple[float, float] | None = None

    @property
    def wrong(self) -> bool:
        """A missed label or a false positive."""
        return self.status in (MISSED, FALSE_POSITIVE)


def drawn_boxes(
    objects: Sequence[KittiObject],
    calibration: Calibration,
    size: tuple[int, int],
    verdicts: Mapping[int, Explanation] | None = None,
    partners: Sequence[KittiObject] = (),
) -> list[DrawnBox]:
    """Paths of all objects that have a 3D box.

    size      (height, width) of the image in pixels
    verdicts  place in `objects` -> what became of the object, where that is known
    partners  of labels: the detections that their verdicts speak of
    """
    places = [i for i, item in enumerate(objects) if item.type in DRAWN and min(item.size) > 0]
    solid = [objects[i] for i in places]
    corner_sets = corners(boxes_of(solid))
    found = []
    for place, item, points in zip(places, solid, corner_sets):
        verdict = (verdicts or {}).get(place)
        paths = wireframe(points, calibration, size), footprint(points, calibration)
        title = ", ".join(filter(None, (_title(item), verdict_text(verdict))))
        velo = calibration.cam_to_velo(points)
        met = partners[verdict.partner - 1].score if partners and verdict is not None and verdict.partner else None
        status = verdict.status if verdict is not None else ""
        found.append(DrawnBox(item.type, *paths, title, item.score, velo, status, met, name_place(paths[0], size)))
    return found


def _title(item: KittiObject) -> str:
    distance = f"{item.location[2]:.1f} m"
    if item.score is None:
        return f"true {item.type}, {distance}, occluded {item.occluded}, truncated {item.truncated:.2f}"
    return f"predicted {item.type}, {distance}, score {item.score:.2f}"


def wireframe(points: NDArray[np.float64], calibration: Calibration, size: tuple[int, int]) -> str:
    """Path data of the twelve edges; parts behind the camera are cut off at 0.3 m. Empty when nothing is visible.

    points  (8, 3) corners in the rectified camera frame, metres
    """
    height, width = size
    lines: list[str] = []
    for first, second in EDGES:
        edge = _in_front(points[first], points[second])
        if edge is None:
            continue
        (u1, v1), (u2, v2) = calibration.cam_to_image(edge)[0]
        outside = max(u1, u2) < 0 or min(u1, u2) > width or max(v1, v2) < 0 or min(v1, v2) > height
        if not outside:
            lines.append(f"M{u1:.1f} {v1:.1f}L{u2:.1f} {v2:.1f}")
    return "".join(lines)


def name_place(path: str, size: tuple[int, int]) -> tuple[float, float] | None:
    """(x, y) of the top left corner of a wireframe's path data, inside an image of (height, width); None without."""
    numbers = np.array(re.findall(r"-?\d+\.\d", path), np.float64).reshape(-1, 2)
    if not len(numbers):
        return None
    x, y = numbers.min(axis=0)
    return float(np.clip(x, 0, size[1] - 60)), float(np.clip(y, 14, size[0]))


def _in_front(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The part of the segment a-b with z >= MIN_DEPTH, or None."""
    if a[2] < MIN_DEPTH and b[2] < MIN_DEPTH:
        return None
    if a[2] < MIN_DEPTH:
        a = a + (b - a) * (MIN_DEPTH - a[2]) / (b[2] - a[2])
    elif b[2] < MIN_DEPTH:
        b = b + (a - b) * (MIN_DEPTH - b[2]) / (a[2] - b[2])
    return np.stack([a, b])


def footprint(points: NDArray[np.float64], calibration: Calibration) -> str:
    """Path data of the bottom face from above, with a line from the centre to the middle of the front edge."""
    place = BirdsEye().pixels(calibration.cam_to_velo(points[:4]))
    centre, front = place.mean(axis=0), (place[0] + place[1]) / 2
    outline = "L".join(f"{x:.1f} {y:.1f}" for x, y in place)
    return f"M{outline}ZM{centre[0]:.1f} {centre[1]:.1f}L{front[0]:.1f} {front[1]:.1f}"
