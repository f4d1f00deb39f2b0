"""The detections of a run, matched: AP with confidence intervals, PR curves, worst mistakes with their reasons."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from detection.evaluation.bootstrap import Interval, Resampling, confidence_intervals, paired_differences
from detection.evaluation.difficulty import LEVELS
from detection.evaluation.explain import FALSE_POSITIVE, MISSED, Explanation, explain
from detection.evaluation.kitti_ap import Evaluation, prepare
from detection.evaluation.protocol import EVERYWHERE, METRICS, Target
from detection.kitti_format import KittiObject
from pipeline.base.errors import DataError
from pipeline.base.paths import RunFolder
from pipeline.data import Dataset
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.scoring.tables import METRIC_NAMES

RESAMPLING = Resampling(resamples=200)
HARD = LEVELS.index("hard")
# (frame, "label" or "detection", place in its list from 0) -> what became of it
Verdicts = dict[tuple[str, str, int], Explanation]


@dataclass(frozen=True)
class MatchedFrames:
    """Labels and detections of the frames that have both, and how they fit together."""

    labels: dict[str, list[KittiObject]] = field(default_factory=dict)
    detections: dict[str, list[KittiObject]] = field(default_factory=dict)
    evaluation: Evaluation | None = None
    verdicts: Verdicts = field(default_factory=dict)


@dataclass(frozen=True)
class Mistake:
    """A label that no detection found, or a detection of nothing.

    weight  how bad: metres that a missed object is nearer than 100 m, or percent of all scores that a false one reaches
    """

    frame: str
    kind: str
    item: KittiObject
    reason: str
    weight: float


def judge(config: Config, run: RunFolder, dataset: Dataset, frames: Sequence[str]) -> MatchedFrames:
    """Reads labels and detections and matches them; frames with damaged files are left out (scores name them)."""
    labels: dict[str, list[KittiObject]] = {}
    detections: dict[str, list[KittiObject]] = {}
    for frame_id in frames:
        frame = dataset[frame_id]
        if not frame.has("labels") or not run.detections(frame_id).is_file():
            continue
        try:
            pair = frame.labels, FrameOutputs(run, frame_id).read_detections()
        except DataError:
            continue
        labels[frame_id], detections[frame_id] = pair
    if not labels:
        return MatchedFrames()
    # Curves and mistakes are shown over all distances; metrics.json has the ranges asked for.
    evaluation = prepare(labels, detections, config.evaluation, metrics=METRICS, ranges=(EVERYWHERE,))
    return MatchedFrames(labels, detections, evaluation, verdicts(evaluation))


def verdicts(evaluation: Evaluation) -> Verdicts:
    """What became of every object in 3D at the hard level, matched by its own class at that class's strictest IoU."""
    found: Verdicts = {}
    for target in strictest(evaluation, "3d"):
        for item in explain(evaluation.matcher, target, HARD):
            if item.type.lower() == target.cls.lower():
                found[item.frame, item.side, item.line - 1] = item
    return found


def strictest(evaluation: Evaluation, metric: str) -> list[Target]:
    """One target per class: the one with the highest IoU."""
    best: dict[str, Target] = {}
    for target in evaluation.targets:
        if target.metric == metric and (target.cls not in best or target.iou > best[target.cls].iou):
            best[target.cls] = target
    return list(best.values())


def mistakes(matched: MatchedFrames) -> list[Mistake]:
    """Missed objects and false positives, the worst first: near misses and sure false positives."""
    scores = sorted(item.score or 0.0 for items in matched.detections.values() for item in items)
    found = []
    for (frame, side, place), verdict in matched.verdicts.items():
        if verdict.status not in (MISSED, FALSE_POSITIVE):
            continue
        reason = f"{verdict.reason} ({verdict.detail})" if verdict.detail else verdict.reason
        if side == "label":
            item = matched.labels[frame][place]
            found.append(Mistake(frame, "missed", item, reason, 100.0 - item.location[2]))
        else:
            item = matched.detections[frame][place]
            rank = bisect_right(scores, item.score or 0.0) / len(scores)
            found.append(Mistake(frame, "false", item, reason, 100.0 * rank))
    return sorted(found, key=lambda mistake: (-mistake.weight, mistake.frame))


def verdict_text(verdict: Explanation | None) -> str:
    """Words for a tooltip: what became of the object and why."""
    if verdict is None:
        return ""
    detail = f", {verdict.detail}" if verdict.detail else ""
    status = {"matched": "", "ignored": "not counted: "}.get(verdict.status, f"{verdict.status}: ")
    return f"{status}{verdict.reason}{detail}"


# --- tables


def ap_cells(matched: MatchedFrames) -> list[list[str]]:
    """Rows of class, metric, IoU, AP with its interval at the three levels, and object counts."""
    if matched.evaluation is None:
        return []
    intervals = confidence_intervals(matched.evaluation, RESAMPLING)
    rows = []
    for row, start in zip(matched.evaluation.rows(), range(0, len(intervals), len(LEVELS))):
        if not any(row["n_gt"]):
            continue
        cells = [_interval_text(item) for item in intervals[start : start + len(LEVELS)]]
        counts = " / ".join(str(count) for count in row["n_gt"])
        rows.append([row["class"], METRIC_NAMES[row["metric"]], f"{row['iou']:g}", *cells, counts])
    return rows


def _interval_text(item: Interval) -> str:
    if item.ap is None:
        return "-"
    if item.low is None or item.high is None:
        return f"{item.ap:.1f}"
    return f"{item.ap:.1f} [{item.low:.0f}–{item.high:.0f}]"


def difference_rows(first: MatchedFrames, second: MatchedFrames) -> list[list[str]]:
    """AP of this run, of the other, and the paired difference with its interval, per class, metric and level; last,
    "sure" where the interval is without 0.

    Only the frames that both have are compared, empty when there is none; rows without any AP are left out.
    """
    shared = [frame for frame in first.labels if frame in second.detections]
    if first.evaluation is None or not shared:
        return []
    # The first of the two is what differences are taken from.
    evaluations = {
        "other": _on(second, shared, first.evaluation),
        "this": _on(first, shared, first.evaluation),
    }
    return [
        [
            row.target.cls,
            METRIC_NAMES[row.target.metric],
            f"{row.target.iou:g}",
            row.level,
            f"{row.ap:.1f}",
            f"{row.ap - row.difference:.1f}",
            f"{row.difference:+.1f} [{row.low:+.1f}, {row.high:+.1f}]",
            "sure" if row.low > 0 or row.high < 0 else "",
        ]
        for row in paired_differences(evaluations, RESAMPLING)
        if row.target.metric in ("3d", "bev") and (row.ap > 0 or row.ap != row.difference)
    ]


def _on(matched: MatchedFrames, frames: Sequence[str], like: Evaluation) -> Evaluation:
    """The evaluation on some frames, by the protocol of `like`."""
    labels = {frame: matched.labels[frame] for frame in frames}
    return prepare(labels, {frame: matched.detections[frame] for frame in frames}, like.protocol)


# --- precision-recall curves as SVG paths


@dataclass(frozen=True)
class CurvePanel:
    """One small diagram; paths in a 100 x 100 square, precision upwards."""

    title: str
    paths: list[tuple[str, str]]
    area: str


def curve_panels(matched: MatchedFrames) -> list[CurvePanel]:
    """3D and bird's-eye curves of every class of which something was found."""
    if matched.evaluation is None:
        return []
    panels = []
    for metric in ("3d", "bev"):
        for target in strictest(matched.evaluation, metric):
            curves = matched.evaluation.curves(target)
            paths = [(level, _curve_path(c.precision())) for level, c in zip(LEVELS, curves) if len(c.thresholds)]
            if any(c.precision().any() for c in curves if len(c.thresholds)):
                values = matched.evaluation.average_precision(target)
                area = " / ".join("-" if value is None else f"{value:.1f}" for value in values)
                panels.append(CurvePanel(f"{target.cls}, {METRIC_NAMES[metric]}, IoU {target.iou:g}", paths, area))
    return panels


def _curve_path(precision: Any) -> str:
    places = [f"{100 * i / (len(precision) - 1):.1f} {100 - 100 * value:.1f}" for i, value in enumerate(precision)]
    return "M" + "L".join(places)
