"""Rotated and axis-aligned NMS against the definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from detection.ops import nms_axis_aligned, nms_rotated
from tests.detection.ops.test_rotated_iou import CAR, moved, random_boxes
from tests.reference import ops_boxes as twin

CASES = [(nms_rotated, twin.iou_bev), (nms_axis_aligned, twin.iou_unrotated)]


@pytest.mark.parametrize(("suppress", "pair"), CASES)
@given(seed=st.integers(0, 2**32 - 1), threshold=st.sampled_from([0.0, 0.1, 0.45, 0.8]))
@settings(max_examples=15, deadline=None)
def test_keeps_what_the_definition_keeps(suppress, pair, seed: int, threshold: float) -> None:
    rng = np.random.default_rng(seed)
    boxes = random_boxes(rng, 30)
    boxes[20:24] = boxes[:4]  # identical boxes
    scores = rng.integers(-5, 5, 30).astype(float)  # with ties and negative logits
    assert suppress(boxes, scores, threshold).tolist() == twin.nms(boxes, scores, threshold, pair)


@pytest.mark.parametrize("suppress", [nms_rotated, nms_axis_aligned])
def test_limit_is_a_prefix_of_the_whole(suppress, rng: np.random.Generator) -> None:
    boxes, scores = random_boxes(rng, 200), rng.normal(size=200)
    whole = suppress(boxes, scores, 0.3)
    assert len(whole) > 7
    assert np.array_equal(suppress(boxes, scores, 0.3, 7), whole[:7])
    assert len(suppress(boxes, scores, 0.3, 0)) == 0


def test_threshold_itself_does_not_suppress() -> None:
    boxes = np.stack([moved(r=0.0), moved(r=0.0)])
    boxes[1, 0] += 2.0  # l = 4: IoU is exactly 1/3
    assert nms_axis_aligned(boxes, np.array([2.0, 1.0]), 2.0 / (8.0 - 2.0)).tolist() == [0, 1]
    assert nms_axis_aligned(boxes, np.array([2.0, 1.0]), 0.33).tolist() == [0]


def test_only_the_rotated_one_sees_the_heading() -> None:
    boxes, scores = np.stack([CAR, moved(r=CAR[6] + np.pi / 2)]), np.array([0.5, 1.0])
    assert nms_rotated(boxes, scores, 0.5).tolist() == [1, 0]
    assert nms_axis_aligned(boxes, scores, 0.5).tolist() == [1]


def test_tensors_give_tensors_and_nothing_gives_nothing(rng: np.random.Generator) -> None:
    boxes, scores = random_boxes(rng, 50), rng.normal(size=50)
    kept = nms_rotated(torch.from_numpy(boxes), torch.from_numpy(scores), 0.1)
    assert kept.dtype == torch.int64
    assert kept.tolist() == nms_rotated(boxes, scores, 0.1).tolist()
    assert nms_rotated(torch.zeros(0, 7), torch.zeros(0), 0.1).shape == (0,)


def test_wrong_input_is_named() -> None:
    with pytest.raises(ValueError, match=r"scores: expected \(1,\)"):
        nms_rotated(CAR[None], np.ones(2), 0.1)
    with pytest.raises(ValueError, match="NaN"):
        nms_rotated(CAR[None], np.array([np.nan]), 0.1)
    with pytest.raises(ValueError, match="limit"):
        nms_axis_aligned(CAR[None], np.ones(1), 0.1, -1)
