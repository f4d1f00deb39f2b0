"""The usual causes of an AP near zero, recognised from the two tables."""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations

import numpy as np

from detection.evaluation.matcher import Matcher
from detection.evaluation.objects import Array, ObjectTable
from detection.evaluation.overlaps import overlaps_of
from detection.evaluation.protocol import Target
from detection.evaluation.reading import BROKEN_LINE, FramePair

Change = Callable[[Array], Array]

# A cause is named when it would at least double the labels found, and adds this many and this share of all.
_LEAST_GAIN, _LEAST_SHARE = 3, 0.2


def likely_causes(matcher: Matcher, target: Target) -> list[str]:
    """One sentence per cause that would explain a low AP of the target's class; empty when none is recognised."""
    causes = _about_labels(matcher, target) + _about_detections(matcher.pair, target)
    if not causes:
        causes = _about_geometry(matcher.pair, target)
    return causes


def _about_labels(matcher: Matcher, target: Target) -> list[str]:
    labels = matcher.pair.labels
    if len(labels) == 0:
        return ["every label file is empty: a test split has no public labels; evaluate a split that has (val)"]
    same = labels.is_type(target.cls)
    if not same.any():
        return [f"no label is a {target.cls}; the labels hold {_types(labels)}"]
    if not any((matcher.flags(target, level)[0] == 0).any() for level in range(3)):
        return [
            f"all {int(same.sum())} {target.cls} labels are ignored at every difficulty "
            "(height, occlusion, truncation or range); see the reasons"
        ]
    return []


def _about_detections(pair: FramePair, target: Target) -> list[str]:
    detections = pair.detections
    broken = [message for kind, message in pair.problems if kind == BROKEN_LINE]
    if len(detections) == 0 and broken:
        return [f"no line of the result files could be used ({len(broken)} broken): {broken[0]}"]
    if len(detections) == 0:
        return ["every result file is empty: nothing was detected in any frame"]
    same = detections.is_type(target.cls)
    if not same.any():
        return [f"no detection is a {target.cls}; the results hold {_types(detections)}"]
    causes = []
    if (np.abs(detections.height_2d[same]) < 25).all():
        causes.append(
            f"all {int(same.sum())} {target.cls} detections have a 2D box lower than 25 px and are ignored, in BEV and "
            "3D too: project the 3D box into the image and write its rectangle"
        )
    boxes = detections.boxes_3d[same]
    if target.overlap != "2d" and ((boxes[:, 0] == -1000) | (boxes[:, 3] <= 0)).all():
        causes.append(f"the {target.cls} detections carry no 3D box (location -1000 or size -1): only 2D can be scored")
    turned = float((np.abs(boxes[:, 6]) > 2 * np.pi).mean())
    if target.overlap != "2d" and turned > _LEAST_SHARE:
        causes.append(f"the yaw looks like degrees: {100 * turned:.0f} % of the {target.cls} detections exceed 2 pi")
    scores = detections.score[same]
    if len(scores) > 3 and np.ptp(scores) == 0:
        causes.append(f"all scores are {scores[0]:g}: the curve has a single point; write the detector's confidence")
    return causes


def _about_geometry(pair: FramePair, target: Target) -> list[str]:
    """Changes of the detections' boxes that would let many more labels be found in 3D."""
    if target.overlap == "2d":
        return []
    least = min(target.iou, 0.5)
    as_written, total = _found(pair, target, least), int(pair.labels.is_type(target.cls).sum())
    tried = {}
    for words, change in _changes().items():
        changed = pair.detections.with_boxes_3d(change(pair.detections.boxes_3d))
        tried[words] = _found(FramePair(pair.labels, changed), target, least)
    sentence = max(tried, key=lambda words: tried[words])
    best, before = tried[sentence][0], as_written[0]
    if best < 2 * before or best - before < max(_LEAST_GAIN, _LEAST_SHARE * total):
        return []
    return [
        f"{sentence}: undoing it, {best} instead of {before} of {total} {target.cls} labels "
        f"overlap a detection by more than {least:g} in 3D"
    ]


def _found(pair: FramePair, target: Target, least: float) -> tuple[int, float]:
    """Labels of the class with a detection of the class of a 3D IoU above `least`, and the sum of these IoUs."""
    overlaps = overlaps_of(pair.labels, pair.detections, "3d", floor=least)
    label_of_pair = np.repeat(np.arange(len(pair.labels)), np.diff(overlaps.start))
    same = pair.labels.is_type(target.cls)[label_of_pair]
    same &= pair.detections.is_type(target.cls)[overlaps.detection]
    return len(np.unique(label_of_pair[same])), float(overlaps.iou[same].sum())


def _changes() -> dict[str, Change]:
    """Words for a mistake -> what undoes it on (N, 7) x y z h w l ry."""
    changes: dict[str, Change] = {
        "the yaw has the wrong sign": lambda b: _with(b, ry=-b[:, 6]),
        "the yaw is off by 90 degrees": lambda b: _with(b, ry=b[:, 6] + np.pi / 2),
        "the yaw is a LiDAR heading, counter-clockwise from +x (ry = -heading - pi/2)": lambda b: _with(
            b, ry=-b[:, 6] - np.pi / 2
        ),
        "y is the centre of the box; KITTI wants the bottom (y + h/2)": lambda b: _with(b, y=b[:, 1] + b[:, 3] / 2),
        "y is the top of the box; KITTI wants the bottom (y + h)": lambda b: _with(b, y=b[:, 1] + b[:, 3]),
        "boxes are in the LiDAR frame (x forward, l w h, heading); KITTI wants the rectified camera": _from_lidar,
    }
    for order in permutations("hwl"):
        if order != ("h", "w", "l"):
            columns = [3 + order.index(name) for name in "hwl"]
            changes[f"the sizes are written {' '.join(order)}; KITTI wants h w l"] = _reordered(columns)
    return changes


def _reordered(columns: list[int]) -> Change:
    return lambda b: b[:, [0, 1, 2, *columns, 6]]


def _with(boxes: Array, y: Array | None = None, ry: Array | None = None) -> Array:
    changed = boxes.copy()
    if y is not None:
        changed[:, 1] = y
    if ry is not None:
        changed[:, 6] = ry
    return changed


def _from_lidar(boxes: Array) -> Array:
    """Undo x y z l w h heading of the LiDAR frame, with the axes swapped and without the (small) calibration offset."""
    x, y, z, l, w, h, heading = boxes.T
    return np.column_stack([-y, -z + h / 2, x, h, w, l, -heading - np.pi / 2])


def _types(table: ObjectTable) -> str:
    counts = np.bincount(table.type, minlength=len(table.types))
    return ", ".join(f"{name} ({count})" for name, count in zip(table.types, counts) if count)
