"""Why every label was found, missed or ignored, and every detection right, wrong or ignored."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from detection.evaluation.difficulty import MAX_OCCLUSION, MAX_TRUNCATION, KittiDifficulty
from detection.evaluation.matcher import Matcher
from detection.evaluation.matching import IGNORED, INVISIBLE, VALID, Flags, match_all
from detection.evaluation.objects import ALPHA, OCCLUDED, SCORE, TRUNCATED, Array, Mask, ObjectTable, Z
from detection.evaluation.overlaps import Index
from detection.evaluation.protocol import NEIGHBOURS, Target

MATCHED, MISSED, LEFT_OUT, FALSE_POSITIVE = "matched", "missed", "ignored", "false positive"


@dataclass(frozen=True)
class Explanation:
    """What became of one object.

    side     "label" or "detection"      line    its line in the file (place in the list for objects in memory)
    status   matched, missed, ignored or false positive
    reason   the rule that decided, countable; `detail` adds the numbers
    partner  of a match: the line of the object matched, on the other side; 0 otherwise
    """

    frame: str
    side: str
    line: int
    type: str
    status: str
    reason: str
    detail: str = ""
    partner: int = 0

    def __str__(self) -> str:
        detail = f" ({self.detail})" if self.detail else ""
        return f"{self.frame} {self.side} {self.line} {self.type}: {self.status}, {self.reason}{detail}"


def explain(matcher: Matcher, target: Target, level: int) -> list[Explanation]:
    """One explanation per label and detection of every frame, with every detection admitted whatever its score.

    level  0 easy, 1 moderate, 2 hard
    """
    story = _Story.of(matcher, target, level)
    found: list[Explanation] = []
    for f in range(len(matcher.pair.frames)):
        found.extend(story.label(row) for row in matcher.pair.labels.rows(f))
        found.extend(story.detection(row) for row in matcher.pair.detections.rows(f))
    return found


def sum_reasons(explanations: Iterable[Explanation]) -> list[tuple[str, str, str, int]]:
    """(side, status, reason, count), the most frequent first within each side."""
    counts = Counter((item.side, item.status, item.reason) for item in explanations)
    ordered = sorted(counts.items(), key=lambda entry: (entry[0][0] != "label", -entry[1], entry[0]))
    return [(*key, count) for key, count in ordered]


@dataclass(frozen=True)
class _Story:
    """The outcome of the matching for one target and level, and the words for it."""

    matcher: Matcher
    target: Target
    level: int
    label_flag: Flags
    detection_flag: Flags
    match: Index  # label -> detection or -1
    taken_by: Index  # detection -> label or -1
    of_detection: dict[int, list[tuple[int, float]]]  # detection -> (label, IoU)
    label_inside: Mask  # within the range
    detection_inside: Mask
    label_height: Array  # of the 2D box, pixels
    detection_height: Array
    same_class: Mask  # detections of the class

    @classmethod
    def of(cls, matcher: Matcher, target: Target, level: int) -> _Story:
        labels, detections = matcher.pair.labels, matcher.pair.detections
        overlaps = matcher.overlaps(target.overlap)
        candidates = matcher.match_candidates(target, level)
        match = match_all(candidates)
        taken_by = np.full(len(detections), -1, dtype=np.int64)
        taken_by[match[match >= 0]] = np.flatnonzero(match >= 0)
        pairs: dict[int, list[tuple[int, float]]] = {}
        label_of_pair = np.repeat(np.arange(len(labels)), np.diff(overlaps.start))
        for g, d, iou in zip(label_of_pair.tolist(), overlaps.detection.tolist(), overlaps.iou.tolist()):
            pairs.setdefault(d, []).append((g, iou))
        return cls(
            matcher,
            target,
            level,
            candidates.label_flag,
            candidates.detection_flag,
            match,
            taken_by,
            pairs,
            matcher.in_range(labels, target.range),
            matcher.in_range(detections, target.range),
            labels.height_2d,
            np.abs(detections.height_2d),
            detections.is_type(target.cls),
        )

    def label(self, g: int) -> Explanation:
        labels, detections = self.matcher.pair.labels, self.matcher.pair.detections
        d = int(self.match[g])
        if self.label_flag[g] == INVISIBLE:
            reason = "DontCare area" if self.matcher.dontcare[g] else "other class"
            return _words(labels, g, "label", LEFT_OUT, reason)
        if self.label_flag[g] == IGNORED:
            return _words(labels, g, "label", LEFT_OUT, *self._why_ignored(g))
        if d >= 0 and self.detection_flag[d] == VALID:
            score = f"line {detections.line[d]}, score {detections.values[d, SCORE]:g}, IoU {self._iou(g, d):.3f}"
            return _words(labels, g, "label", MATCHED, "found", score, int(detections.line[d]))
        if d >= 0:
            return _words(labels, g, "label", LEFT_OUT, "found by an ignored detection", f"line {detections.line[d]}")
        return _words(labels, g, "label", MISSED, *self._why_missed(g))

    def _why_ignored(self, g: int) -> tuple[str, str]:
        """The rules that keep a label of the class (or its neighbour) from counting."""
        labels, values = self.matcher.pair.labels, self.matcher.pair.labels.values[g]
        neighbour = NEIGHBOURS.get(self.target.cls.lower(), "")
        if labels.types[labels.type[g]].lower() == neighbour.lower():
            return "neighbouring class", neighbour
        if not self.label_inside[g]:
            return "out of range", f"z {values[Z]:.2f} m"
        if not isinstance(self.matcher.difficulty, KittiDifficulty):
            return "beyond the difficulty", f"truncated {values[TRUNCATED]:g}, occluded {values[OCCLUDED]:g}"
        height = float(self.label_height[g])
        reasons = []
        if values[OCCLUDED] > MAX_OCCLUSION[self.level]:
            reasons.append(("occluded", f"{values[OCCLUDED]:g} > {MAX_OCCLUSION[self.level]}"))
        if values[TRUNCATED] > MAX_TRUNCATION[self.level]:
            reasons.append(("truncated", f"{values[TRUNCATED]:g} > {MAX_TRUNCATION[self.level]:g}"))
        limit = self.matcher.difficulty.min_height[self.level]
        if height < limit or (self.matcher.protocol.flavor == "python" and height == limit):
            reasons.append(("height under limit", f"{height:.2f} of {limit:g} px"))
        return " and ".join(name for name, _ in reasons), ", ".join(text for _, text in reasons)

    def _why_missed(self, g: int) -> tuple[str, str]:
        """The best that overlaps the label, and why it does not match it."""
        overlaps, detections = self.matcher.overlaps(self.target.overlap), self.matcher.pair.detections
        pairs = range(int(overlaps.start[g]), int(overlaps.start[g + 1]))
        if not pairs:
            return "no detection overlaps", ""
        same = self.same_class
        best = max(pairs, key=lambda p: (same[overlaps.detection[p]], overlaps.iou[p]))
        any_class = max(pairs, key=lambda p: overlaps.iou[p])
        d, iou = int(overlaps.detection[best]), float(overlaps.iou[best])
        where = f"line {detections.line[d]}, IoU {iou:.3f}"
        if overlaps.iou[any_class] > self.target.iou and not (same[d] and iou > self.target.iou):
            d = int(overlaps.detection[any_class])
            return "wrong class", f"line {detections.line[d]} is {detections.types[detections.type[d]]}"
        if not same[d]:
            return "no detection of the class overlaps", where
        if iou <= self.target.iou:
            return "IoU too low", f"{where} <= {self.target.iou:g}"
        if self.taken_by[d] >= 0:
            return "its detection belongs to another label", where
        return "its detection is out of range", where

    def detection(self, d: int) -> Explanation:
        detections = self.matcher.pair.detections
        status, reason, detail = self._verdict(d)
        partner = int(self.matcher.pair.labels.line[self.taken_by[d]]) if status == MATCHED else 0
        return _words(detections, d, "detection", status, reason, detail, partner)

    def _verdict(self, d: int) -> tuple[str, str, str]:
        labels, detections = self.matcher.pair.labels, self.matcher.pair.detections
        flag, g = self.detection_flag[d], int(self.taken_by[d])
        if flag != VALID:
            limit = self.matcher.difficulty.min_height[self.level]
            height = float(self.detection_height[d])
            if flag == IGNORED and height < limit:
                return LEFT_OUT, "height under limit", f"{height:.2f} of {limit:g} px"
            if not self.detection_inside[d]:
                return LEFT_OUT, "out of range", f"z {detections.values[d, Z]:.2f} m"
            return LEFT_OUT, "other class", ""
        if g >= 0 and self.label_flag[g] == VALID:
            return MATCHED, "finds a label", f"line {labels.line[g]}, IoU {self._iou(g, d):.3f}"
        if g >= 0:
            return LEFT_OUT, "finds an ignored label", f"line {labels.line[g]}, {self._why_ignored(g)[0]}"
        share = float(self.matcher.overlaps(self.target.overlap).dontcare[d])
        if share > self.target.iou:
            return LEFT_OUT, "in a DontCare area", f"share {share:.3f}"
        return FALSE_POSITIVE, *self._why_false(d)

    def _why_false(self, d: int) -> tuple[str, str]:
        labels = self.matcher.pair.labels
        pairs = self.of_detection.get(d, [])
        if not pairs:
            return self._why_nothing(d)
        g, iou = max(pairs, key=lambda pair: pair[1])
        where = f"line {labels.line[g]}, IoU {iou:.3f}"
        if iou <= self.target.iou:
            return "IoU too low", f"{where} <= {self.target.iou:g}"
        if self.label_flag[g] == INVISIBLE:
            return "wrong class", f"line {labels.line[g]} is {labels.types[labels.type[g]]}"
        return "label found by another detection", where

    def _why_nothing(self, d: int) -> tuple[str, str]:
        """No label is near: DontCare areas excuse a detection only where rectangles in the image are compared."""
        share = float(self.matcher.overlaps("2d").dontcare[d])
        if share > 0.5:
            return "in a DontCare area", f"share {share:.3f}, which this metric counts all the same"
        return "nothing there", ""

    def _iou(self, g: int, d: int) -> float:
        return next(iou for label, iou in self.of_detection[d] if label == g)


def _words(
    table: ObjectTable, row: int, side: str, status: str, reason: str, detail: str = "", partner: int = 0
) -> Explanation:
    frame = table.frames[int(np.searchsorted(table.offsets, row, side="right")) - 1]
    return Explanation(frame, side, int(table.line[row]), table.types[table.type[row]], status, reason, detail, partner)


def orientation_errors(matcher: Matcher, target: Target, level: int) -> tuple[float, float] | None:
    """Mean |alpha difference| in degrees and share in percent turned by more than 90 degrees, over matched labels.

    None when nothing matches.
    """
    labels, detections = matcher.pair.labels, matcher.pair.detections
    candidates = matcher.match_candidates(target, level)
    match = match_all(candidates)
    rows = np.flatnonzero((match >= 0) & (candidates.label_flag == VALID))
    rows = rows[candidates.detection_flag[match[rows]] == VALID]
    if len(rows) == 0:
        return None
    turn = labels.values[rows, ALPHA] - detections.values[match[rows], ALPHA]
    error = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
    return float(np.degrees(error).mean()), float(100 * (error > np.pi / 2).mean())
