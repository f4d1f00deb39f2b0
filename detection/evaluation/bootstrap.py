"""How far AP values would scatter on other frames: percentile bootstrap over frames, and paired differences.

Frames are drawn with replacement (Efron's bootstrap), because objects of one frame are not independent. The thresholds
of the curve are chosen anew in every resample.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from detection.evaluation.curves import resampled_ap
from detection.evaluation.difficulty import LEVELS
from detection.evaluation.kitti_ap import Evaluation
from detection.evaluation.objects import Array
from detection.evaluation.overlaps import Index
from detection.evaluation.protocol import Target
from detection.evaluation.reading import InputError


@dataclass(frozen=True)
class Resampling:
    """How often and how surely: B resamples from a seed, intervals that hold `confidence` of them."""

    resamples: int = 1000
    seed: int = 0
    confidence: float = 0.95

    def __post_init__(self) -> None:
        if self.resamples < 2:
            raise ValueError(f"bootstrap: expected at least 2 resamples, got {self.resamples}")
        if not 0 < self.confidence < 1:
            raise ValueError(f"confidence: expected a share between 0 and 1, got {self.confidence}")

    def weights(self, n_frames: int) -> Index:
        """(B, F) int64, how often each frame is drawn in each resample."""
        rng = np.random.default_rng(self.seed)
        drawn = (rng.integers(0, n_frames, n_frames) for _ in range(self.resamples))
        return np.stack([np.bincount(rows, minlength=n_frames) for rows in drawn]).astype(np.int64)

    def interval(self, values: Array) -> tuple[float, float]:
        """The percentile interval of (B,) values."""
        tail = (1 - self.confidence) / 2
        low, high = np.quantile(values, [tail, 1 - tail])
        return float(low), float(high)


@dataclass(frozen=True)
class Interval:
    """AP in percent of one target and level with its percentile interval; None where there is no AP."""

    target: Target
    level: str
    ap: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Difference:
    """AP of a result set minus AP of the baseline on the same frames, in percent points.

    low, high    percentile interval of the paired difference; an interval without 0 is a difference at this confidence
    share_above  share of resamples in which the result set is better
    """

    target: Target
    level: str
    name: str
    baseline: str
    ap: float
    difference: float
    low: float
    high: float
    share_above: float


def confidence_intervals(evaluation: Evaluation, resampling: Resampling) -> list[Interval]:
    """Every AP value of the evaluation with its percentile interval."""
    weights = resampling.weights(len(evaluation.matcher.pair.frames))
    found = []
    for target in evaluation.targets:
        for place, (level, ap) in enumerate(zip(LEVELS, evaluation.average_precision(target))):
            low = high = None
            if ap is not None:
                low, high = resampling.interval(_resampled(evaluation, target, place, weights))
            found.append(Interval(target, level, ap, low, high))
    return found


def paired_differences(evaluations: Mapping[str, Evaluation], resampling: Resampling) -> list[Difference]:
    """Every result set against the first, each resample drawn once for both; rows without an AP are left out.

    Raises InputError when the sets were not evaluated on the same frames.
    """
    names = list(evaluations)
    baseline = evaluations[names[0]]
    frames = baseline.matcher.pair.frames
    for name in names[1:]:
        if evaluations[name].matcher.pair.frames != frames:
            raise InputError(f"{name}: evaluated on other frames than {names[0]}; a paired comparison needs the same")
    weights = resampling.weights(len(frames))
    rows = []
    for target in baseline.targets:
        for place, level in enumerate(LEVELS):
            reference = baseline.average_precision(target)[place]
            if reference is None:
                continue
            drawn = _resampled(baseline, target, place, weights)
            for name in names[1:]:
                ap = evaluations[name].average_precision(target)[place]
                if ap is None:
                    continue
                differences = _resampled(evaluations[name], target, place, weights) - drawn
                low, high = resampling.interval(differences)
                above = float((differences > 0).mean())
                rows.append(Difference(target, level, name, names[0], ap, ap - reference, low, high, above))
    return rows


def _resampled(evaluation: Evaluation, target: Target, place: int, weights: Index) -> Array:
    records = evaluation.records[target][place]
    return resampled_ap(records, weights, evaluation.recall_points, orientation=target.metric == "aos")
