"""Who counts: the flags every label and detection carries into the matching, by the rules of a protocol."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from detection.evaluation.difficulty import DifficultyRule
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
from detection.evaluation.protocol import EVERYWHERE, NEIGHBOURS, EvaluationProtocol, Flavor, Range, Target
from detection.evaluation.reading import FramePair


def label_flags(labels: ObjectTable, cls: str, counts: Mask, in_range: Mask) -> Flags:
    """(G,) flags: 0 the class within the difficulty and range, 1 the class otherwise or its neighbour, -1 others."""
    flags = np.full(len(labels), INVISIBLE, dtype=np.int8)
    neighbour = NEIGHBOURS.get(cls.lower())
    if neighbour is not None:
        flags[labels.is_type(neighbour)] = IGNORED
    same = labels.is_type(cls)
    flags[same] = np.where((counts & in_range)[same], VALID, IGNORED)
    return flags


def detection_flags(detections: ObjectTable, cls: str, min_height: float, flavor: Flavor) -> Flags:
    """(D,) flags: 1 lower in the image than the difficulty asks, *whatever the class*; 0 the class; -1 others."""
    height = np.abs(detections.height_2d)
    if flavor == "cpp":
        height = np.trunc(height)  # the devkit stores it in an int
    flags = np.where(detections.is_type(cls), VALID, INVISIBLE).astype(np.int8)
    flags[height < min_height] = IGNORED
    return flags


@dataclass(frozen=True)
class Matcher:
    """Labels and detections with the rules that decide who counts; overlaps are computed once per kind."""

    pair: FramePair
    protocol: EvaluationProtocol = field(default_factory=EvaluationProtocol)

    @cached_property
    def difficulty(self) -> DifficultyRule:
        """Which labels count at easy, moderate and hard."""
        return self.protocol.rule

    @cached_property
    def dontcare(self) -> Mask:
        """(G,) which labels are DontCare areas; the port reads the name case-sensitively."""
        labels = self.pair.labels
        return labels.is_exactly("DontCare") if self.protocol.flavor == "python" else labels.is_type("DontCare")

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
            if self.protocol.flavor == "python" and kind != "2d":
                found.dontcare[:] = 0.0  # the port knows DontCare in the image only
            self._overlaps[kind] = found
        return self._overlaps[kind]

    def in_range(self, table: ObjectTable, bounds: Range) -> Mask:
        """(N,) whether lo <= distance < hi; everything is inside (0, None)."""
        lo, hi = bounds
        if bounds == EVERYWHERE:
            return np.ones(len(table), dtype=bool)
        distance = table.values[:, Z]
        if self.protocol.range_axis == "radius":
            distance = np.hypot(table.values[:, X], distance)
        return np.asarray((distance >= lo) & (distance < (np.inf if hi is None else hi)))

    def flags(self, target: Target, level: int) -> tuple[Flags, Flags]:
        """Flags of labels (G,) and detections (D,) at a difficulty level (0 easy, 1 moderate, 2 hard)."""
        labels, detections = self.pair.labels, self.pair.detections
        on_label = label_flags(labels, target.cls, self._level_counts[level], self.in_range(labels, target.range))
        on_detection = detection_flags(detections, target.cls, self.difficulty.min_height[level], self.protocol.flavor)
        outside = ~self.in_range(detections, target.range)
        if self.protocol.range_rule == "clocs":
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
        kept = (
            self.in_range(detections, target.range)
            if self.protocol.range_rule == "clocs"
            else np.ones(len(detections), bool)
        )
        if target.metric == "aos" and not self._has_orientation(kept):
            return False
        usable = kept & detections.is_type(target.cls)
        if self.protocol.flavor == "cpp":
            column, least = {"2d": (3, 0.0), "bev": (X, None), "3d": (Y, None)}[target.overlap]
            value = detections.values[:, column]
            usable &= value != -1000 if least is None else value >= least
        return bool(usable.any())

    def _has_orientation(self, kept: Mask) -> bool:
        """cpp: no detection at all has alpha -10; python: the first one has not."""
        alpha = self.pair.detections.alpha[kept]
        if len(alpha) == 0:
            return False
        return bool(alpha[0] != -10) if self.protocol.flavor == "python" else not bool((alpha == -10).any())


def levels(matcher: Matcher, target: Target) -> Iterator[MatchRecords]:
    """Match records at easy, moderate and hard."""
    for level in range(3):
        yield matcher.records(target, level)
