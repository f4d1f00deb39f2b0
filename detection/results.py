"""Detections as KITTI result lines: projected and clipped 2D boxes, alpha, and the reference's drop rule."""

from __future__ import annotations

from detection.boxes import observation_angle, project_to_image
from detection.kitti_format import KittiObject
from detection.types import Detections, PointFrame


def result_objects(detections: Detections, frame: PointFrame) -> list[KittiObject]:
    """Result objects of a frame; truncation and occlusion are -1.

    The 2D box is the rectangle of the projected corners clipped to [0, W-1] x [0, H-1]. A detection is left out unless
    that box is narrower than 0.8 W and lower than 0.8 H (EPNet and PointRCNN), or when nothing of it is in the image.
    """
    height, width = frame.image_size
    rectangles = project_to_image(detections.boxes, frame.P2, frame.image_size)
    angles = observation_angle(detections.boxes)
    found = []
    for box, name, score, (x1, y1, x2, y2), alpha in zip(
        detections.boxes.values, detections.classes, detections.scores, rectangles, angles
    ):
        if not (0 < x2 - x1 < 0.8 * width and 0 < y2 - y1 < 0.8 * height):
            continue
        x, y, z, h, w, l, ry = (float(value) for value in box)
        bbox = (float(x1), float(y1), float(x2), float(y2))
        found.append(KittiObject(name, -1, -1, float(alpha), bbox, (h, w, l), (x, y, z), ry, float(score)))
    return found
