"""Numbers of a detection run: AP with bootstrap over frames, and where AP is lost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from detection.evaluation.bootstrap import Resampling
from detection.evaluation.curves import resampled_ap
from detection.evaluation.difficulty import LEVELS, DifficultyRule
from detection.evaluation.explain import explain, sum_reasons
from detection.evaluation.kitti_ap import Evaluation, found_share, prepare
from detection.evaluation.protocol import EVERYWHERE, Range, RecallPoints, Target
from detection.kitti_format import KittiObject
from pipeline.experiments.chapter_5 import REASONS

Objects = Mapping[str, list[KittiObject]]

# Table 5.2; the first is everything.
RANGES: tuple[Range, ...] = (EVERYWHERE, (0.0, 30.0), (30.0, 70.0))
IOUS = (0.7, 0.5)


def view_of(bounds: Range) -> str:
    """Prefix of a range's numbers: "" for everything, "0-30/"."""
    return "" if bounds == EVERYWHERE else f"{bounds[0]:g}-{bounds[1]:g}/"


def name_of(target: Target, level: str) -> str:
    """ "3d_0.7_easy", "30-70/bev_0.5_hard"."""
    return f"{view_of(target.range)}{target.metric}_{target.iou:g}_{level}"


def evaluation_of(labels: Objects, detections: Objects, rule: DifficultyRule, recall: RecallPoints = 40) -> Evaluation:
    """Car in 3D and from above at IoU 0.7 and 0.5, everywhere and per range of distance."""
    return prepare(
        dict(labels),
        dict(detections),
        classes=("Car",),
        metrics=("3d", "bev"),
        ious={"Car": IOUS},
        ranges=RANGES,
        difficulty=rule,
        recall=recall,
        missing="empty",
    )


def ap_numbers(evaluation: Evaluation) -> dict[str, float]:
    """AP in percent of every target and level, 0 where nothing is found; number of labels and recall at IoU 0.5."""
    numbers: dict[str, float] = {}
    for target in evaluation.targets:
        for level, ap in zip(LEVELS, evaluation.average_precision(target)):
            numbers[name_of(target, level)] = 0.0 if ap is None else float(ap)
        if target.metric == "bev" and target.iou == 0.5:
            for level, records in zip(LEVELS, evaluation.records[target]):
                numbers[f"{view_of(target.range)}labels_{level}"] = float(records.n_labels.sum())
                numbers[f"{view_of(target.range)}recall_0.5_{level}"] = found_share(records)
    return numbers


def ap_draws(evaluation: Evaluation, resampling: Resampling) -> dict[str, list[float]]:
    """AP of every resample of the test frames; runs on the same frames share the draws, so they can be paired."""
    weights = resampling.weights(len(evaluation.matcher.pair.frames))
    draws: dict[str, list[float]] = {}
    for target in evaluation.targets:
        if target.range != EVERYWHERE:
            continue
        found = evaluation.average_precision(target)
        for place, level in enumerate(LEVELS):
            values = np.zeros(resampling.resamples)
            if found[place] is not None:
                records = evaluation.records[target][place]
                values = resampled_ap(records, weights, evaluation.recall_points, orientation=False)
            draws[name_of(target, level)] = [round(float(value), 3) for value in values]
    return draws


def intervals_of(draws: Mapping[str, Sequence[float]], resampling: Resampling) -> dict[str, tuple[float, float]]:
    """Percentile interval of every number."""
    return {name: resampling.interval(np.asarray(values)) for name, values in draws.items()}


def where_lost(evaluation: Evaluation) -> dict[str, float]:
    """Why cars are missed and boxes false (moderate, BEV IoU 0.5): "lost/label missed: IoU too low" -> number."""
    target = next(t for t in evaluation.targets if (t.metric, t.iou, t.range) == ("bev", 0.5, EVERYWHERE))
    numbers = dict.fromkeys((f"lost/{reason}" for reason in REASONS), 0.0)
    for side, status, reason, count in sum_reasons(explain(evaluation.matcher, target, 1)):
        if status in ("missed", "false positive", "matched"):
            numbers[f"lost/{side} {status}: {reason}"] = float(count)
    return numbers
