"""Threshold choice and interpolation by hand; the weighted curve against frames written out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from detection.evaluation.bootstrap import Resampling, confidence_intervals, paired_differences
from detection.evaluation.curves import average_precision, curve_of, resampled_ap
from detection.evaluation.kitti_ap import Evaluation, prepare
from detection.evaluation.matching import MatchRecords
from detection.evaluation.reading import InputError
from tests.detection.evaluation.scenes import random_frames, thing
from tests.reference.kitti_ap_twin import thresholds_of


def hits_only(scores: np.ndarray, n_labels: int) -> MatchRecords:
    """Records of one frame whose detections are all true positives."""
    ordered = np.sort(scores)[::-1].astype(float)
    zeros, ones = np.zeros(len(scores), dtype=np.int64), np.ones(len(scores), dtype=np.int64)
    return MatchRecords(np.array([n_labels]), ordered, zeros, ordered, zeros, ones, zeros, np.zeros(len(scores)))


@pytest.mark.parametrize(("n_labels", "hits"), [(1, 1), (5, 3), (40, 40), (41, 41), (80, 80), (100, 80), (1000, 517)])
def test_thresholds_equal_the_plain_loop(n_labels: int, hits: int, rng: np.random.Generator) -> None:
    scores = rng.random(hits)
    expected = thresholds_of(scores.tolist(), n_labels)
    assert curve_of(hits_only(scores, n_labels)).thresholds.tolist() == expected
    assert len(expected) <= 41


def test_80_percent_recall_uses_33_samples() -> None:
    curve = curve_of(hits_only(np.arange(80), 100))
    assert len(curve.thresholds) == 33
    assert average_precision(curve.precision(), 40) == pytest.approx(80)


def test_average_precision_takes_the_named_samples() -> None:
    samples = np.zeros(41)
    samples[0] = 1.0
    assert average_precision(samples, 40) == 0
    assert average_precision(samples, 11) == pytest.approx(100 / 11)
    samples[:] = 1.0
    assert average_precision(samples, 40) == average_precision(samples, 11) == 100


def evaluation_of(seed: int, frames: int = 15, **options) -> Evaluation:
    labels, detections = random_frames(seed, frames)
    return prepare(labels, detections, iou_set="loose", classes=["Car"], **options)


@pytest.mark.parametrize("recall", [40, 11])
@pytest.mark.parametrize("metric", ["2d", "aos", "3d"])
def test_a_weighted_curve_equals_frames_written_several_times(metric: str, recall: int) -> None:
    labels, detections = random_frames(3, 15)
    evaluation = prepare(labels, detections, classes=["Car"], metrics=[metric], iou_set="loose")
    weights = Resampling(resamples=5, seed=1).weights(15)
    drawn = resampled_ap(evaluation.records[evaluation.targets[0]][2], weights, recall, orientation=metric == "aos")
    for row, ap in zip(weights, drawn):
        repeated = [frame for frame, times in enumerate(row) for _ in range(times)]
        written_out = prepare(
            [labels[i] for i in repeated],
            [detections[i] for i in repeated],
            classes=["Car"],
            metrics=[metric],
            iou_set="loose",
            recall=recall,
        )
        assert ap == pytest.approx(written_out.average_precision(written_out.targets[0])[2])


def test_weights_draw_every_frame_equally_and_follow_the_seed() -> None:
    weights = Resampling(resamples=400, seed=7).weights(30)
    assert (weights.sum(axis=1) == 30).all()
    assert weights.mean(axis=0) == pytest.approx(np.ones(30), abs=0.2)
    assert (weights == Resampling(resamples=400, seed=7).weights(30)).all()
    assert (weights != Resampling(resamples=400, seed=8).weights(30)).any()


def test_intervals_hold_the_value_and_widen_with_confidence() -> None:
    evaluation = evaluation_of(2, frames=60)
    narrow = confidence_intervals(evaluation, Resampling(300, 0, 0.5))
    wide = confidence_intervals(evaluation, Resampling(300, 0, 0.99))
    assert len(narrow) == 3 * len(evaluation.targets)
    for inner, outer in zip(narrow, wide):
        assert outer.low <= inner.low <= inner.high <= outer.high
        assert outer.low <= outer.ap <= outer.high
    assert any(item.high - item.low > 1 for item in narrow)


def test_the_interval_of_a_share_is_near_the_binomial_one() -> None:
    # One label a frame, 60 of 100 found without a false positive: AP is the recall, so its spread is sqrt(p q / n).
    labels = [[thing()] for _ in range(100)]
    detections = [[thing(score=0.5)] if i < 60 else [] for i in range(100)]
    evaluation = prepare(labels, detections, classes=["Car"], metrics=["3d"], iou_set="strict")
    interval = confidence_intervals(evaluation, Resampling(2000, 0, 0.95))[0]
    spread = 1.96 * 100 * np.sqrt(0.6 * 0.4 / 100)
    assert interval.low == pytest.approx(60 - spread, abs=2.5)
    assert interval.high == pytest.approx(60 + spread, abs=2.5)


def test_a_set_does_not_differ_from_itself_and_a_worse_one_does() -> None:
    labels, detections = random_frames(4, 80)
    options = {"classes": ["Car"], "metrics": ["2d"], "iou_set": "strict"}
    perfect = [[replace(item, score=1.0) for item in items if item.type != "DontCare"] for items in labels]
    good, poor = prepare(labels, perfect, **options), prepare(labels, detections, **options)
    rows = paired_differences({"poor": poor, "same": poor, "good": good}, Resampling(200, 0, 0.95))
    same = [row for row in rows if row.name == "same"]
    assert all(row.difference == row.low == row.high == 0 for row in same)
    better = [row for row in rows if row.name == "good"]
    assert [row.level for row in better] == ["easy", "moderate", "hard"]
    assert better[2].low > 0
    assert better[2].share_above > 0.99


def test_paired_comparison_refuses_other_frames() -> None:
    with pytest.raises(InputError, match="other frames"):
        paired_differences({"a": evaluation_of(1), "b": evaluation_of(1, frames=14)}, Resampling(10))


@pytest.mark.parametrize("wrong", [{"resamples": 1}, {"confidence": 95}])
def test_resampling_refuses_nonsense(wrong: dict) -> None:
    with pytest.raises(ValueError, match="expected"):
        Resampling(**wrong)
