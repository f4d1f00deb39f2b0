"""KITTI average precision of two folders (or of objects in memory): 2D, AOS, BEV and 3D, as the official devkit.

Protocol: KITTI object development kit (Geiger et al., CVPR 2012); 40 recall points after Simonelli et al. (ICCV 2019).
Explained with figures in docs/evaluation.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypedDict

from detection.evaluation.curves import Curve, average_precision, curve_of, exact_ap
from detection.evaluation.difficulty import LEVELS, Vkitti2Difficulty
from detection.evaluation.matcher import Matcher, levels
from detection.evaluation.matching import MatchRecords
from detection.evaluation.objects import OCCLUDED, TRUNCATED, FrameObjects
from detection.evaluation.protocol import EVERYWHERE, EvaluationProtocol, Range, Target
from detection.evaluation.reading import PathLike, read_pair

ApRow = TypedDict(
    "ApRow",
    {
        "class": str,
        "metric": str,
        "iou": float,
        "recall_points": int,
        "range": list[float | None],
        "easy": float | None,
        "moderate": float | None,
        "hard": float | None,
        "n_gt": list[int],
    },
)


class Report(TypedDict):
    """What `evaluate` returns and `--json` writes.

    results   one row per class, metric, IoU and range; AP in percent, None where a class has no detections
    exact     the same rows with all-point AP (not comparable with published numbers, not capped on small sets)
    recall    the same rows with the share of labels found when every detection is admitted, percent
    warnings  what a reader of the numbers must know, one sentence each
    skipped   kind -> count of what a lenient reading passed over
    protocol  the choices that were made
    """

    results: list[ApRow]
    exact: list[dict[str, Any]]
    recall: list[dict[str, Any]]
    warnings: list[str]
    skipped: dict[str, int]
    protocol: dict[str, Any]


@dataclass(frozen=True)
class Evaluation:
    """Labels and detections matched for a list of targets; everything else is read off its records."""

    matcher: Matcher

    @property
    def protocol(self) -> EvaluationProtocol:
        """What was asked."""
        return self.matcher.protocol

    @cached_property
    def targets(self) -> tuple[Target, ...]:
        """The rows of results, in the order asked for."""
        return self.protocol.targets

    @property
    def recall_points(self) -> int:
        """40 or 11."""
        return self.protocol.recall

    @cached_property
    def records(self) -> dict[Target, tuple[MatchRecords, ...]]:
        """Match records per target at easy, moderate and hard; AOS shares those of 2D."""
        found: dict[tuple[str, str, float, Range], tuple[MatchRecords, ...]] = {}
        for target in self.targets:
            key = (target.cls, target.overlap, target.iou, target.range)
            if key not in found:
                found[key] = tuple(levels(self.matcher, target))
        return {target: found[(target.cls, target.overlap, target.iou, target.range)] for target in self.targets}

    def curves(self, target: Target) -> tuple[Curve, ...]:
        """The sampled curves at easy, moderate and hard."""
        return tuple(curve_of(records) for records in self.records[target])

    def average_precision(self, target: Target) -> tuple[float | None, ...]:
        """AP in percent at easy, moderate and hard; None where the reference gives no value."""
        if not self.matcher.is_evaluated(target):
            return (None, None, None)
        samples = [c.orientation() if target.metric == "aos" else c.precision() for c in self.curves(target)]
        return tuple(average_precision(values, self.recall_points) for values in samples)

    def rows(self) -> list[ApRow]:
        """The result rows, in the order asked for."""
        rows = []
        for target in self.targets:
            easy, moderate, hard = self.average_precision(target)
            row: ApRow = {
                "class": target.cls,
                "metric": target.metric,
                "iou": target.iou,
                "recall_points": self.recall_points,
                "range": list(target.range),
                "easy": easy,
                "moderate": moderate,
                "hard": hard,
                "n_gt": [int(records.n_labels.sum()) for records in self.records[target]],
            }
            rows.append(row)
        return rows

    def report(self) -> Report:
        """Everything `evaluate` returns."""
        matcher = self.matcher
        problems = matcher.pair.problems
        rows = self.rows()
        return {
            "results": rows,
            "exact": [self._side_row(target, exact_ap) for target in self.targets if target.metric != "aos"],
            "recall": [self._side_row(target, found_share) for target in self.targets if target.metric != "aos"],
            "warnings": [
                *self._notes(),
                *small_set_warnings(rows),
                *skipped_summary(problems),
            ],
            "skipped": {kind: sum(1 for found, _ in problems if found == kind) for kind, _ in problems},
            "protocol": self._choices_made(),
        }

    def _notes(self) -> list[str]:
        """What was read otherwise than written; a sentence when the numbers are no ranking by KITTI's rules."""
        notes = list(self.matcher.pair.notes)
        if self.protocol.min_height == "kitti":
            return notes
        return [*notes, "min_height none: objects of every height in the image count; this is not KITTI's ranking"]

    def _choices_made(self) -> dict[str, Any]:
        matcher = self.matcher
        labels = matcher.pair.labels
        protocol: dict[str, Any] = {
            "flavor": self.protocol.flavor,
            "difficulty": str(matcher.difficulty),
            "range_rule": self.protocol.range_rule,
            "range_axis": self.protocol.range_axis,
            "min_height": self.protocol.min_height,
            "frames": len(matcher.pair.frames),
            "labels": len(labels),
            "detections": len(matcher.pair.detections),
        }
        if isinstance(matcher.difficulty, Vkitti2Difficulty):
            columns = (labels.height_2d, labels.values[:, TRUNCATED], labels.values[:, OCCLUDED])
            protocol["objects_per_level"] = {
                cls: matcher.difficulty.level_counts(*(column[labels.is_type(cls)] for column in columns))
                for cls in dict.fromkeys(target.cls for target in self.targets)
            }
        return protocol

    def _side_row(self, target: Target, value: Any) -> dict[str, Any]:
        known = self.matcher.is_evaluated(target)
        numbers = {name: value(r) if known else None for name, r in zip(LEVELS, self.records[target])}
        return {
            "class": target.cls,
            "metric": target.metric,
            "iou": target.iou,
            "range": list(target.range),
            **numbers,
        }


def found_share(records: MatchRecords) -> float:
    """Share in percent of the labels that count which are found when every detection is admitted."""
    n_labels = int(records.n_labels.sum())
    return 100.0 * int(records.tp.sum()) / n_labels if n_labels else 0.0


def skipped_summary(problems: Sequence[tuple[str, str]], shown: int = 3) -> list[str]:
    """The first messages of every kind of problem that was passed over, and how many more there are."""
    by_kind: dict[str, list[str]] = {}
    for kind, message in problems:
        by_kind.setdefault(kind, []).append(message)
    summary = []
    for kind, messages in by_kind.items():
        summary += messages[:shown]
        if len(messages) > shown:
            summary.append(f"{kind}: {len(messages) - shown} more were passed over")
    return summary


def small_set_warnings(rows: Sequence[ApRow]) -> list[str]:
    """One sentence per class, range and level with fewer than 41 labels that count, where AP cannot reach 100."""
    sentences: dict[str, None] = {}
    for row in rows:
        lo, hi = row["range"]
        where = "" if (lo, hi) == EVERYWHERE else f" at {lo:g}-{'inf' if hi is None else f'{hi:g}'} m"
        for level, n in zip(LEVELS, row["n_gt"]):
            if n >= 41:
                continue
            cap = max(n - 1, 0) / 40 if row["recall_points"] == 40 else ((n - 1) // 4 + 1) / 11
            sentences[
                f"{row['class']} {level}{where}: only {n} objects count; with fewer than 41 even a perfect detector "
                f"gets AP {100 * cap:.1f} of 100 (R{row['recall_points']}). Do not compare it; see the exact AP"
            ] = None
    return list(sentences)


def prepare(
    labels: PathLike | FrameObjects,
    detections: PathLike | FrameObjects,
    protocol: EvaluationProtocol | None = None,
    *,
    frames: Sequence[str] | None = None,
    missing: str = "error",
    lenient: bool = False,
    **choices: Any,
) -> Evaluation:
    """Read both sides and set up the evaluation; the arguments are those of `evaluate`."""
    asked = replace(protocol or EvaluationProtocol(), **choices)
    return Evaluation(Matcher(read_pair(labels, detections, frames=frames, missing=missing, lenient=lenient), asked))


def evaluate(
    labels: PathLike | FrameObjects,
    detections: PathLike | FrameObjects,
    protocol: EvaluationProtocol | None = None,
    *,
    frames: Sequence[str] | None = None,
    missing: str = "error",
    lenient: bool = False,
    **choices: Any,
) -> Report:
    """KITTI AP of detections against labels; the same numbers as `run_pipeline --stage evaluate`.

    labels      folder of KITTI label files (15 columns), or frame name -> list of KittiObject, or a list of such lists
    detections  folder of KITTI result files (16 columns, the score last), or the same in memory with scores
    protocol    what counts and how; None = the official devkit's, all classes and metrics
    frames      frames to evaluate (a split); None = every labelled frame
    missing     a frame without result file: "error", "skip" (as the official offline tool) or "empty"
    lenient     pass over broken lines, missing files and results of unknown frames; counted in "skipped"
    choices     fields of `EvaluationProtocol` that replace those of `protocol`: evaluate(a, b, classes=["Car"])
    Raises ValueError (InputError with file and line for bad files).
    """
    reading: dict[str, Any] = {"frames": frames, "missing": missing, "lenient": lenient}
    return prepare(labels, detections, protocol, **reading, **choices).report()
