"""From match records to precision, recall and average precision: 40 and 11 recall points, and all points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from detection.evaluation.matching import MatchRecords
from detection.evaluation.objects import Array
from detection.evaluation.overlaps import Index
from detection.ops._numba import kernel

SAMPLES = 41  # recall 0, 1/40, ..., 1
RECALL_POINTS = (40, 11)


@dataclass(frozen=True)
class Curve:
    """The sampled curve of one class, metric, IoU, range and difficulty.

    n_labels    labels that count (the denominator of recall)
    thresholds  (K,) scores at which the detections are cut, K <= 41, descending
    tp, fp      (K,) counts at these thresholds
    similarity  (K,) sum of (1 + cos(alpha difference)) / 2 over the true positives
    """

    n_labels: int
    thresholds: Array
    tp: Array
    fp: Array
    similarity: Array

    @property
    def recall(self) -> Array:
        """(K,) tp / n_labels."""
        return self.tp / max(self.n_labels, 1)

    @property
    def raw_precision(self) -> Array:
        """(K,) tp / (tp + fp); 0 where nothing is left, for which the devkit writes NaN."""
        return self.tp / np.maximum(self.tp + self.fp, 1)

    def precision(self) -> Array:
        """(41,) interpolated precision: the best at this or any later sample, 0 beyond the last threshold."""
        return _interpolated(self.raw_precision)

    def orientation(self) -> Array:
        """(41,) interpolated orientation similarity."""
        return _interpolated(self.similarity / np.maximum(self.tp + self.fp, 1))


def _interpolated(values: Array) -> Array:
    samples = np.zeros(SAMPLES)
    samples[: len(values)] = values
    return np.maximum.accumulate(samples[::-1])[::-1]


def average_precision(samples: Array, recall_points: int) -> float:
    """AP in percent of (41,) interpolated values.

    recall_points  40: mean of samples 1 to 40 (recall 0 left out; the server since October 2019);
                   11: mean of samples 0, 4, ..., 40
    """
    if recall_points == 40:
        return 100.0 * float(samples[1:].sum()) / 40
    if recall_points == 11:
        return 100.0 * float(samples[::4].sum()) / 11
    raise ValueError(f"recall points: expected 40 or 11, got {recall_points}")


def curve_of(records: MatchRecords) -> Curve:
    """The sampled curve over all frames, each counted once."""
    weights = np.ones(len(records.n_labels), dtype=np.int64)
    thresholds, counts = np.empty(SAMPLES), np.zeros((3, SAMPLES))
    used = _weighted_counts(records, weights, thresholds, counts)
    tp, fp, similarity = (row[:used].copy() for row in counts)
    return Curve(int(records.n_labels.sum()), thresholds[:used].copy(), tp, fp, similarity)


def exact_ap(records: MatchRecords) -> float:
    """All-point AP in percent: the area under the interpolated curve through every score, without the 41 samples.

    It does not depend on how many labels there are, so a perfect detector scores 100 on one frame, too.
    """
    n_labels = int(records.n_labels.sum())
    if n_labels == 0 or len(records.score) == 0:
        return 0.0
    tp, fp = np.cumsum(records.tp), np.cumsum(records.fp)
    last_of_score = np.append(np.diff(records.score) != 0, True)
    tp, fp = tp[last_of_score], fp[last_of_score]
    order = np.argsort(tp, kind="stable")
    recall = np.concatenate([[0.0], tp[order] / n_labels])
    precision = (tp / np.maximum(tp + fp, 1))[order]
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return 100.0 * float((np.diff(recall) * envelope).sum())


def resampled_ap(records: MatchRecords, weights: Index, recall_points: int, *, orientation: bool) -> Array:
    """(B,) AP in percent for B resamples; weights (B, F) int64 says how often each frame is counted.

    Thresholds are chosen anew in every resample, as they depend on its true positives.
    """
    if recall_points not in RECALL_POINTS:
        raise ValueError(f"recall points: expected 40 or 11, got {recall_points}")
    return np.asarray(_resampled_ap(records, weights, recall_points, orientation))


@kernel
def _choose_thresholds(n_labels: int, tp_score: Array, tp_frame: Index, weights: Index, thresholds: Array) -> int:
    """Scores of true positives nearest to recall 0, 1/40, ..., 1; returns how many. Arithmetic as in the devkit."""
    total = 0
    for i in range(len(tp_score)):
        total += weights[tp_frame[i]]
    recall, used, seen = 0.0, 0, 0
    for i in range(len(tp_score)):
        for _ in range(weights[tp_frame[i]]):
            is_last = seen == total - 1
            left = (seen + 1) / n_labels
            right = left if is_last else (seen + 2) / n_labels
            seen += 1
            if (right - recall) < (recall - left) and not is_last:
                continue
            # More than 41 would overrun the devkit's curve; the last sample stays the one at recall 1.
            if used < len(thresholds):
                thresholds[used] = tp_score[i]
                used += 1
            recall += 1.0 / (len(thresholds) - 1.0)
    return used


@kernel
def _weighted_counts(records: MatchRecords, weights: Index, thresholds: Array, counts: Array) -> int:
    """Fill thresholds (41,) and counts (3, 41) of tp, fp, similarity; returns how many samples are used."""
    n_labels = 0
    for f in range(len(weights)):
        n_labels += weights[f] * records.n_labels[f]
    if n_labels == 0:
        return 0
    used = _choose_thresholds(n_labels, records.tp_score, records.tp_frame, weights, thresholds)
    e, tp, fp, similarity = 0, 0, 0, 0.0
    for k in range(used):
        while e < len(records.score) and records.score[e] >= thresholds[k]:
            weight = weights[records.frame[e]]
            tp += weight * records.tp[e]
            fp += weight * records.fp[e]
            similarity += weight * records.similarity[e]
            e += 1
        counts[0, k], counts[1, k], counts[2, k] = tp, fp, similarity
    return used


@kernel
def _resampled_ap(records: MatchRecords, weights: Index, recall_points: int, orientation: bool) -> Array:
    thresholds, counts = np.empty(41), np.zeros((3, 41))
    values = np.zeros(len(weights))
    for b in range(len(weights)):
        used = _weighted_counts(records, weights[b], thresholds, counts)
        best, area = 0.0, 0.0
        for k in range(used - 1, -1, -1):
            found = counts[2, k] if orientation else counts[0, k]
            best = max(best, found / max(counts[0, k] + counts[1, k], 1.0))
            if (recall_points == 40 and k > 0) or (recall_points == 11 and k % 4 == 0):
                area += best
        values[b] = 100.0 * area / recall_points
    return values
