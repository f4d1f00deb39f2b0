"""What is asked for, and the flags every label and detection carries into the matching."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from detection.evaluation.difficulty import DifficultyRule, KittiDifficulty
from detection.evaluation.matching import (
    IGNORED,
    INVISIBLE,
    VALID,
    Flags,
    MatchCandidates,
    MatchRecords,
    match_candidates,
    record_matches,
)
from detection.evaluation.objects import Mask, ObjectTable, X, Y, Z
from detection.evaluation.overlaps import Overlaps, overlaps_of
from detection.evaluation.reading import FramePair

METRICS = ("2d", "aos", "bev", "3d")
IOU_SETS = ("strict", "loose", "both")
FLAVORS = ("cpp", "python")
RANGE_RULES = ("clocs", "border")
RANGE_AXES = ("z", "radius")
KITTI_CLASSES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")

# A neighbouring class is ignored: finding it is neither right nor wrong.
NEIGHBOURS = {"car": "Van", "pedestrian": "Person_sitting"}

Range = tuple[float, float | None]
EVERYWHERE: Range = (0.0, None)


@dataclass(frozen=True)
class Target:
    """One row of results: a class, a metric, the least IoU of a match, and a range in metres [lo, hi)."""

    cls: str
    metric: str
    iou: float
    range: Range = EVERYWHERE

    @property
    def overlap(self) -> str:
        """The overlap that decides a match: AOS is matched in the image."""
        return "2d" if self.metric == "aos" else self.metric


def min_overlap(cls: str, metric: str, iou_set: str) -> float:
    """Least IoU of the strict (Car 0.7, others 0.5) or loose set (bev and 3d: 0.5 and 0.25; image as strict)."""
    is_car = cls.lower() == "car"
    if iou_set == "loose" and metric in ("bev", "3d"):
        return 0.5 if is_car else 0.25
    return 0.7 if is_car else 0.5


def targets_of(
    classes: Sequence[str],
    iou_set: str,
    ious: Mapping[str, Sequence[float]],
    ranges: Sequence[Range],
    metrics: Sequence[str],
) -> tuple[Target, ...]:
    """Every row asked for, each once (image rows of the strict and loose set are the same).

    ious  class -> IoUs that replace the sets for that class. Raises ValueError for what cannot be asked.
    """
    _check_request(classes, iou_set, ious, ranges, metrics)
    sets = ("strict", "loose") if iou_set == "both" else (iou_set,)
    own = {name.lower(): values for name, values in ious.items()}
    rows = [
        Target(cls, metric, min_overlap(cls, metric, limit) if isinstance(limit, str) else float(limit), bounds)
        for bounds in ranges
        for cls in classes
        for limit in own.get(cls.lower(), sets)
        for metric in metrics
    ]
    return tuple(dict.fromkeys(rows))


def _check_request(
    classes: Sequence[str],
    iou_set: str,
    ious: Mapping[str, Sequence[float]],
    ranges: Sequence[Range],
    metrics: Sequence[str],
) -> None:
    if isinstance(classes, str) or not classes:
        raise ValueError(f"classes: expected a list of class names, got {classes!r}")
    if any(name.lower() == "dontcare" for name in classes):
        raise ValueError("classes: DontCare marks areas and cannot be evaluated")
    if iou_set not in IOU_SETS:
        raise ValueError(f"IoU set: expected one of {', '.join(IOU_SETS)}, got {iou_set!r}")
    for name, values in ious.items():
        if name.lower() not in {cls.lower() for cls in classes}:
            raise ValueError(f"IoU of {name}: that class is not evaluated ({', '.join(classes)} are)")
        impossible = [value for value in values if not 0 <= value < 1]
        if impossible:
            raise ValueError(f"IoU of {name}: expected 0 <= IoU < 1 (a match needs more than it), got {impossible[0]}")
    for lo, hi in ranges:
        if hi is not None and not lo < hi:
            raise ValueError(f"range: expected LO < HI in metres, got {lo} {hi}")
    wrong = [metric for metric in metrics if metric not in METRICS]
    if wrong:
        raise ValueError(f"metric: expected some of {', '.join(METRICS)}, got {wrong[0]!r}")


def label_flags(labels: ObjectTable, cls: str, counts: Mask, in_range: Mask) -> Flags:
    """(G,) flags: 0 the class within the difficulty and range, 1 the class otherwise or its neighbour, -1 others."""
    flags = np.full(len(labels), INVISIBLE, dtype=np.int8)
    neighbour = NEIGHBOURS.get(cls.lower())
    if neighbour is not None:
        flags[labels.is_type(neighbour)] = IGNORED
    same = labels.is_type(cls)
    flags[same] = np.where((counts & in_range)[same], VALID, IGNORED)
    return flags


def detection_flags(detections: ObjectTable, cls: str, min_height: float, flavor: str) -> Flags:
    """(D,) flags: 1 lower in the image than the difficulty asks, *whatever the class*; 0 the class; -1 others."""
    height = np.abs(detections.height_2d)
    if flavor == "cpp":
        height = np.trunc(height)  # the devkit stores it in an int
    flags = np.where(detections.is_type(cls), VALID, INVISIBLE).astype(np.int8)
    flags[height < min_height] = IGNORED
    return flags


@dataclass(frozen=True)
class Matcher:
    """Labels and detections with the rules that decide who counts; overlaps are computed once per kind.

    flavor      "cpp" (official devkit) or "python" (the widely used port)
    range_rule  "clocs": detections outside a range are dropped, labels outside ignored;
                "border": a detection outside that overlaps a label inside still counts, others outside are ignored
    range_axis  "z" (depth along the optical axis) or "radius" (distance on the ground)
    """

    pair: FramePair
    flavor: str = "cpp"
    range_rule: str = "clocs"
    range_axis: str = "z"
    difficulty: DifficultyRule = field(default_factory=KittiDifficulty)

    def __post_init__(self) -> None:
        for name, allowed in (("flavor", FLAVORS), ("range_rule", RANGE_RULES), ("range_axis", RANGE_AXES)):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name}: expected {' or '.join(allowed)}, got {getattr(self, name)!r}")

    @cached_property
    def dontcare(self) -> Mask:
        """(G,) which labels are DontCare areas; the port reads the name case-sensitively."""
        labels = self.pair.labels
        return labels.is_exactly("DontCare") if self.flavor == "python" else labels.is_type("DontCare")

    @cached_property
    def _level_counts(self) -> Mask:
        labels = self.pair.labels
        return self.difficulty.counts(labels.height_2d, labels.values[:, 0], labels.values[:, 1])

    @cached_property
    def _overlaps(self) -> dict[str, Overlaps]:
        return {}

    def overlaps(self, kind: str) -> Overlaps:
        """Pairs of the kind "2d", "bev" or "3d" with any overlap at all."""
        if kind not in self._overlaps:
            found = overlaps_of(self.pair.labels, self.pair.detections, kind, floor=0.0, dontcare=self.dontcare)
            if self.flavor == "python" and kind != "2d":
                found.dontcare[:] = 0.0  # the port knows DontCare in the image only
            self._overlaps[kind] = found
        return self._overlaps[kind]

    def in_range(self, table: ObjectTable, bounds: Range) -> Mask:
        """(N,) whether lo <= distance < hi; everything is inside (0, None)."""
        lo, hi = bounds
        if bounds == EVERYWHERE:
            return np.ones(len(table), dtype=bool)
        distance = table.values[:, Z]
        if self.range_axis == "radius":
            distance = np.hypot(table.values[:, X], distance)
        return np.asarray((distance >= lo) & (distance < (np.inf if hi is None else hi)))

    def flags(self, target: Target, level: int) -> tuple[Flags, Flags]:
        """Flags of labels (G,) and detections (D,) at a difficulty level (0 easy, 1 moderate, 2 hard)."""
        labels, detections = self.pair.labels, self.pair.detections
        on_label = label_flags(labels, target.cls, self._level_counts[level], self.in_range(labels, target.range))
        on_detection = detection_flags(detections, target.cls, self.difficulty.min_height[level], self.flavor)
        outside = ~self.in_range(detections, target.range)
        if self.range_rule == "clocs":
            on_detection[outside] = INVISIBLE
        elif outside.any():
            overlaps = self.overlaps(target.overlap)
            label_of_pair = np.repeat(np.arange(len(labels)), np.diff(overlaps.start))
            hits = (overlaps.iou > target.iou) & (on_label[label_of_pair] == VALID)
            outside[overlaps.detection[hits]] = False
            on_detection[outside & (on_detection == VALID)] = IGNORED
        return on_label, on_detection

    def records(self, target: Target, level: int) -> MatchRecords:
        """Both matching passes over all frames."""
        labels, detections = self.pair.labels, self.pair.detections
        alphas = (labels.alpha, detections.alpha)
        return record_matches(labels.offsets, detections.offsets, self.match_candidates(target, level), alphas)

    def match_candidates(self, target: Target, level: int) -> MatchCandidates:
        """Overlaps, flags and scores of one target and level, as the matching takes them."""
        flags = self.flags(target, level)
        return match_candidates(self.overlaps(target.overlap), target.iou, flags, self.pair.detections.score)

    def is_evaluated(self, target: Target) -> bool:
        """Whether the reference gives a value: the class is detected at least once, and for AOS with orientation."""
        detections = self.pair.detections
        kept = self.in_range(detections, target.range) if self.range_rule == "clocs" else np.ones(len(detections), bool)
        if target.metric == "aos" and not self._has_orientation(kept):
            return False
        usable = kept & detections.is_type(target.cls)
        if self.flavor == "cpp":
            column, least = {"2d": (3, 0.0), "bev": (X, None), "3d": (Y, None)}[target.overlap]
            value = detections.values[:, column]
            usable &= value != -1000 if least is None else value >= least
        return bool(usable.any())

    def _has_orientation(self, kept: Mask) -> bool:
        """cpp: no detection at all has alpha -10; python: the first one has not."""
        alpha = self.pair.detections.alpha[kept]
        if len(alpha) == 0:
            return False
        return bool(alpha[0] != -10) if self.flavor == "python" else not bool((alpha == -10).any())


def levels(matcher: Matcher, target: Target) -> Iterator[MatchRecords]:
    """Match records at easy, moderate and hard."""
    for level in range(3):
        yield matcher.records(target, level)
