"""Checks of one frame's labels or results: columns, sizes, angles, rectangles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from detection.boxes import observation_angle, project_to_image, wrap_angle
from detection.kitti_format import KittiObject, boxes_of, parse_lines
from pipeline.base.errors import DataError
from pipeline.base.files import read_text
from pipeline.check.faults import Finding
from pipeline.geometry.calibration import Calibration

CLASSES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare")
# Longer than wide and higher than long never holds for these.
_VEHICLES = ("Car", "Van", "Truck", "Tram", "Cyclist")
# Labels are rounded to 0.01 rad; drawn boxes and locations leave up to 0.1 rad between alpha and ry.
_ANGLE_TOLERANCE = 0.3
_PIXEL_TOLERANCE = 3.0
# KITTI marks "not estimated" by -10 in alpha and -1000 in locations.
UNKNOWN_ALPHA = -10.0


def read_objects(path: Path, frame: str, scored: bool) -> tuple[list[KittiObject], list[Finding]]:
    """The objects of a label file (or of a result file with `scored`) and what is wrong with its lines."""
    try:
        text = read_text(path, "a KITTI result file" if scored else "a KITTI label file")
        objects = parse_lines(text, where=path.name, scored=None if scored else False)
        with_scores = parse_lines(text, where=path.name)
    except ValueError as error:
        message = f"expected {error.expected}, got {error.found}" if isinstance(error, DataError) else str(error)
        return [], [Finding("malformed_labels", frame, str(path), message)]
    if scored and any(o.score is None for o in objects):
        what = "15 columns in a folder of results"
    elif not scored and any(_is_result(o) for o in with_scores):
        what = "results (scores in column 16) in a folder of labels"
    else:
        return objects, []
    return [], [Finding("label_result_mixup", frame, str(path), what)]


def _is_result(item: KittiObject) -> bool:
    """Scores are fractions or come with -1 -1; exports of labels fill column 16 with a whole number (nuScenes: 0)."""
    return item.score is not None and (item.score % 1 != 0 or (item.truncated == -1 and item.occluded == -1))


def wide_lines(path: Path) -> int:
    """The most columns of a line of a label file, 0 when it cannot be read."""
    try:
        return max((len(line.split()) for line in read_text(path, "labels").splitlines()), default=0)
    except DataError:
        return 0


def check_objects(
    objects: list[KittiObject],
    frame: str,
    where: str,
    calibration: Calibration | None,
    size: tuple[int, int] | None,
) -> list[Finding]:
    """Faults of a frame's objects; calibration and image size (height, width) are used when given."""
    cared = [o for o in objects if o.type.lower() != "dontcare"]
    findings = []
    unknown = sorted({o.type for o in objects} - set(CLASSES))
    if unknown:
        findings.append(Finding("unknown_class", frame, where, ", ".join(unknown)))
    message = _degrees(cared)
    if message:
        return [*findings, Finding("degrees_not_radians", frame, where, message)]
    message = _unit(cared)
    if message:
        return [*findings, Finding("label_unit", frame, where, message)]
    message = "" if calibration is None else _in_lidar_frame(cared, calibration)
    if message:
        return [*findings, Finding("labels_in_lidar_frame", frame, where, message)]
    message = _dimensions(cared)
    if message:
        return [*findings, Finding("swapped_dimensions", frame, where, message)]
    message = _yaw(cared, calibration, size)
    if message:
        return [*findings, Finding("yaw_sign", frame, where, message)]
    message = "" if size is None else _outside(cared, size)
    return [*findings, Finding("label_outside_image", frame, where, message)] if message else findings


def _degrees(objects: list[KittiObject]) -> str:
    limit = 2 * np.pi + 0.01
    wrong = [o for o in objects if any(abs(angle) > limit and angle != UNKNOWN_ALPHA for angle in (o.ry, o.alpha))]
    return f"{wrong[0].type} with ry {wrong[0].ry:g}, alpha {wrong[0].alpha:g}" if wrong else ""


def _unit(objects: list[KittiObject]) -> str:
    wrong = [o for o in objects if max(o.size) > 100 or (max(map(abs, o.location)) > 300 and o.location[0] != -1000)]
    return f"{wrong[0].type} of size {wrong[0].size} at {wrong[0].location}" if wrong else ""


def _in_lidar_frame(objects: list[KittiObject], calibration: Calibration) -> str:
    """A message when the locations fall into their rectangles only as points of the LiDAR frame."""
    known = [o for o in objects if o.location[0] != -1000 and o.bbox[3] - o.bbox[1] > 1]
    if not known:
        return ""
    given = np.array([o.location for o in known])
    as_camera, as_lidar = (_inside(known, points, calibration) for points in (given, calibration.velo_to_cam(given)))
    if as_camera.mean() > 0.2 or as_lidar.mean() < 0.6:
        return ""
    first = known[int(np.argmax(as_lidar))]
    return f"{first.type} at {first.location} lies in its rectangle only when x is forward and z up"


def _inside(objects: list[KittiObject], points: NDArray[np.float64], calibration: Calibration) -> NDArray[np.bool_]:
    """(N,) whether points in the camera frame fall into the rectangles, a quarter of their size wider on each side."""
    pixels, depth = calibration.cam_to_image(points)
    boxes = np.array([o.bbox for o in objects])
    margin = 0.25 * (boxes[:, 2:] - boxes[:, :2]) + _PIXEL_TOLERANCE
    inside = (pixels > boxes[:, :2] - margin) & (pixels < boxes[:, 2:] + margin)
    return np.asarray(inside.all(axis=1) & (depth > 0.5))


def _dimensions(objects: list[KittiObject]) -> str:
    """Vehicles that are shorter than wide, or much higher than long."""
    for o in objects:
        h, w, l = o.size
        if o.type in _VEHICLES and h > 0 and (l < 0.8 * w or (o.type != "Cyclist" and l < 0.8 * h)):
            return f"{o.type} of height {h:g}, width {w:g}, length {l:g} m"
    return ""


def _yaw(objects: list[KittiObject], calibration: Calibration | None, size: tuple[int, int] | None) -> str:
    """A message when -ry explains alpha (or, without alpha, the rectangles) and ry does not."""
    known = [o for o in objects if o.alpha != UNKNOWN_ALPHA and o.location[2] > 0]
    if known:
        boxes = boxes_of(known)
        alpha = np.array([o.alpha for o in known])
        direction = boxes.ry - observation_angle(boxes)
        given = np.abs(wrap_angle(observation_angle(boxes) - alpha))
        negated = np.abs(wrap_angle(-boxes.ry - direction - alpha))
        wrong = (given > _ANGLE_TOLERANCE) & (negated < _ANGLE_TOLERANCE)
        # An object seen along its side has ry near -ry: only those that tell the two apart are counted.
        telling = np.abs(wrap_angle(2 * boxes.ry)) > 2 * _ANGLE_TOLERANCE
        if (wrong & telling).sum() > 0.5 * telling.sum():
            index = int(np.argmax(wrong & telling))
            return f"{known[index].type}: ry {boxes.ry[index]:.2f} does not fit alpha {alpha[index]:.2f}, -ry does"
        return ""
    if calibration is None or size is None or not objects:
        return ""
    return _yaw_by_rectangles(objects, calibration, size)


def _yaw_by_rectangles(objects: list[KittiObject], calibration: Calibration, size: tuple[int, int]) -> str:
    """The same from 2D boxes, for labels without alpha: needs several objects, since rectangles change little."""
    seen = [o for o in objects if o.location[2] > 2 and o.truncated < 0.1]
    if len(seen) < 5:
        return ""
    boxes = boxes_of(seen)
    mirrored = boxes.values.copy()
    mirrored[:, 6] *= -1
    target = np.array([o.bbox for o in seen])
    errors = [
        float(np.median(np.abs(project_to_image(type(boxes)(values), calibration.P2, size) - target).max(axis=1)))
        for values in (boxes.values, mirrored)
    ]
    wrong = errors[0] > 2 * errors[1] + _PIXEL_TOLERANCE
    return f"rectangles differ by {errors[0]:.0f} px with ry, by {errors[1]:.0f} px with -ry" if wrong else ""


def _outside(objects: list[KittiObject], size: tuple[int, int]) -> str:
    height, width = size
    for o in objects:
        x1, y1, x2, y2 = o.bbox
        beyond = min(x1, y1) < -_PIXEL_TOLERANCE or x2 > width + _PIXEL_TOLERANCE or y2 > height + _PIXEL_TOLERANCE
        if beyond or x2 < x1 or y2 < y1:
            return f"{o.type} rectangle {x1:g} {y1:g} {x2:g} {y2:g} in an image of {width} x {height}"
    return ""
