"""Examination of what runs and other programs write: depth maps, clouds and result files of a frame."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from pipeline.base.errors import DataError
from pipeline.base.paths import RunFolder
from pipeline.check.depths import check_depth, read_map
from pipeline.check.faults import Finding
from pipeline.check.frames import Place
from pipeline.check.labels import check_objects, read_objects
from pipeline.check.virtual import lidar_map
from pipeline.data.frame import Frame

_CLOUD_ROW = 20


def examine_run_frame(open_frame: Callable[[str], Frame], root: Path, place: Place, name: str) -> list[Finding]:
    """Faults of a run's files of one frame: depth/, cloud/, detections/."""
    run = RunFolder(root)
    findings = examine_depth_file(open_frame, run.depth(place.frame), place)
    findings += _examine_cloud(run.cloud(place.frame), place.frame)
    return findings + examine_objects_file(open_frame, run.detections(place.frame), place, scored=True)


def examine_depth_frame(open_frame: Callable[[str], Frame], root: Path, place: Place, name: str) -> list[Finding]:
    """Faults of one map in a folder of depth PNGs."""
    return examine_depth_file(open_frame, root / f"{name}.png", place)


def examine_results_frame(open_frame: Callable[[str], Frame], root: Path, place: Place, name: str) -> list[Finding]:
    """Faults of one file in a folder of KITTI results."""
    return examine_objects_file(open_frame, root / f"{name}.txt", place, scored=True)


def examine_labels_frame(open_frame: Callable[[str], Frame], root: Path, place: Place, name: str) -> list[Finding]:
    """Faults of one file in a folder of KITTI labels."""
    return examine_objects_file(open_frame, root / f"{name}.txt", place, scored=False)


def examine_depth_file(open_frame: Callable[[str], Frame], path: Path, place: Place) -> list[Finding]:
    """Faults of one depth PNG, judged by the frame's LiDAR."""
    if not path.is_file():
        return []
    depth, found = read_map(path, place.frame)
    if depth is None:
        return found
    try:
        frame = open_frame(place.frame)
        reference, calibration = frame.sparse_depth, frame.calibration if frame.has("calibration") else None
    except DataError as error:
        return [Finding("unreadable_file", place.frame, error.where, str(error))]
    near = [(other, partial(lidar_map, open_frame, other)) for other in place.neighbours]
    return check_depth(depth, reference, calibration, place.frame, str(path), near)


def _examine_cloud(path: Path, frame: str) -> list[Finding]:
    if not path.is_file():
        return []
    data = path.read_bytes()
    if not data:
        return [Finding("empty_file", frame, str(path), "0 bytes")]
    if len(data) % _CLOUD_ROW:
        message = f"{len(data)} bytes are not rows of 5 float32 (x y z intensity source)"
        return [Finding("truncated_cloud", frame, str(path), message)]
    rows = np.frombuffer(data, dtype="<f4").reshape(-1, 5)
    if not np.isfinite(rows).all():
        return [Finding("non_finite_points", frame, str(path), "NaN or infinite values")]
    if not np.isin(rows[:, 4], (0, 1)).all():
        return [Finding("wrong_columns", frame, str(path), "column 5 holds more than the sources 0 and 1")]
    return []


def examine_objects_file(open_frame: Callable[[str], Frame], path: Path, place: Place, scored: bool) -> list[Finding]:
    """Faults of one label or result file; empty files are sound (nothing found)."""
    if not path.is_file():
        return []
    objects, found = read_objects(path, place.frame, scored)
    if found or not objects:
        return found
    try:
        frame = open_frame(place.frame)
        calibration = frame.calibration if frame.has("calibration") else None
        size = frame.image_size if frame.has("image_size") else None
    except DataError:
        calibration, size = None, None
    return check_objects(objects, place.frame, str(path), calibration, size)
