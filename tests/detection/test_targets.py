"""Point labels, RoI sampling and noise, labels of RoIs."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from detection.models.box_coding import MEAN_SIZES, boxes_from_rois, rcnn_coder, to_roi_frame
from detection.ops import iou_3d_aligned
from detection.targets import (
    RoiSamplingSettings,
    add_roi_noise,
    choose_rois,
    classification_labels,
    perturb,
    point_labels,
    sample_rois,
    soft_labels,
)
from tests.detection.scenes import place_cars
from tests.reference.box_codes import perfect_code

ONE = torch.ones(1, dtype=torch.long)


def test_points_inside_near_and_outside_a_box() -> None:
    box = torch.tensor([[0.0, 1.0, 10.0, 2.0, 2.0, 4.0, 0.0]])  # x -2..2, y -1..1, z 9..11
    points = torch.tensor([[0.0, 0, 10], [2.1, 0, 10], [2.3, 0, 10], [0, 1.1, 10], [0, 0, 11.19], [0, -1.3, 10]])
    labels, owner = point_labels(points, box, ONE * 3)
    assert labels.tolist() == [3, -1, 0, -1, -1, 0]
    assert owner[0] == 0


def test_the_later_box_decides_as_in_the_reference() -> None:
    # Two cars bumper to bumper: x -2..2 and 2.05..6.05; a point inside one lies in the ring of the other.
    boxes = torch.tensor([[0.0, 1, 10, 2, 2, 4, 0], [4.05, 1, 10, 2, 2, 4, 0]])
    classes = torch.ones(2, dtype=torch.long)
    points = torch.tensor([[1.95, 0.0, 10], [2.1, 0, 10]])
    assert point_labels(points, boxes, classes)[0].tolist() == [-1, 1]
    assert point_labels(points, boxes.flip(0), classes)[0].tolist() == [1, -1]


def test_no_boxes_means_background() -> None:
    assert point_labels(torch.rand(4, 3), torch.zeros(0, 7), torch.zeros(0, dtype=torch.long))[0].tolist() == [0] * 4


def kinds(best: np.ndarray, index: np.ndarray) -> tuple[int, int, int]:
    iou = best[index]
    return int((iou >= 0.55).sum()), int(((iou >= 0.05) & (iou < 0.45)).sum()), int((iou < 0.05).sum())


@pytest.mark.parametrize(
    ("ious", "expected"),
    [
        ([0.9] * 40 + [0.3] * 5 + [0.0] * 5, (32, 25, 7)),  # 32 background: int(0.8 * 32) hard
        ([0.9] * 10 + [0.3] * 5 + [0.0] * 5, (10, 43, 11)),
        ([0.9] * 10 + [0.3] * 5, (10, 54, 0)),
        ([0.9] * 10 + [0.0] * 5, (10, 0, 54)),
        ([0.9] * 3, (64, 0, 0)),
        ([0.3] * 3 + [0.0] * 3, (0, 51, 13)),
    ],
)
def test_roi_sampling_counts(ious, expected, rng) -> None:
    best = np.array(ious + [0.5] * 20)  # between 0.45 and 0.55: never drawn
    index, foreground = choose_rois(best, RoiSamplingSettings(), rng)
    assert kinds(best, index) == expected
    assert len(index) == 64
    assert foreground == expected[0]
    if expected[0] in (10, 32):
        assert len(set(index[:foreground].tolist())) == foreground


def test_only_in_between_rois_do_not_fail(rng) -> None:
    index, foreground = choose_rois(np.array([0.5, 0.47]), RoiSamplingSettings(), rng)
    assert len(index) == 64
    assert foreground == 0


def test_noise_stays_within_the_largest_row(rng) -> None:
    box = np.tile([1.0, 1.5, 20.0, 1.5, 1.6, 4.0, 0.2], (3000, 1))
    moved = perturb(box, rng)
    assert np.abs(moved[:, :3] - box[:, :3]).max() <= 1.0
    assert np.abs(moved[:, :3] - box[:, :3]).max() > 0.9
    assert np.abs(moved[:, 3:6] / box[:, 3:6] - 1).max() <= 0.15
    assert np.abs(moved[:, 6] - 0.2).max() <= np.pi / 3


def test_noise_is_redrawn_for_foreground_only(rng) -> None:
    truth = np.tile([1.0, 1.5, 20.0, 1.5, 1.6, 4.0, 0.2], (400, 1))
    settings = RoiSamplingSettings()
    rois, iou = add_roi_noise(truth, truth, 200, settings, rng)
    np.testing.assert_allclose(iou, iou_3d_aligned(rois, truth), atol=1e-12)
    # Ten tries at about one in two leave hardly any foreground RoI below; one try leaves many.
    assert (iou[:200] < settings.foreground).mean() < 0.02
    assert (iou[200:] < settings.foreground).mean() > 0.2
    assert (rois[200:] == truth[200:]).all(axis=1).mean() == pytest.approx(settings.keep, abs=0.08)


def test_rois_match_truth_of_their_class_only(rng) -> None:
    box = torch.tensor([[1.0, 1.5, 20.0, 1.5, 1.6, 4.0, 0.2]])
    settings = RoiSamplingSettings(noise_tries=0)
    assert (sample_rois(box, ONE, box, ONE, settings, rng).iou == 1).all()
    assert (sample_rois(box, ONE * 2, box, ONE, settings, rng).iou == 0).all()
    assert (sample_rois(box, ONE, torch.zeros(0, 7), ONE[:0], settings, rng).iou == 0).all()
    with pytest.raises(ValueError, match="at least one proposal"):
        sample_rois(box[:0], ONE[:0], box, ONE, settings, rng)


def test_ground_truth_as_proposals_returns_through_the_second_stage(rng) -> None:
    truth = torch.tensor(place_cars(12, rng, farthest=60))
    classes = torch.ones(12, dtype=torch.long)
    chosen = sample_rois(truth, classes, truth, classes, RoiSamplingSettings(), rng)
    kept = chosen.iou > 0.55
    assert int(kept.sum()) > 50
    mean, coder = torch.tensor(MEAN_SIZES["Car"], dtype=torch.float64), rcnn_coder()
    rois, boxes = chosen.rois[kept], chosen.truth[kept]
    local = to_roi_frame(boxes, rois)
    code = perfect_code(coder, coder.encode(local[:, :3], local[:, 3:6], local[:, 6], mean))
    refined = boxes_from_rois(rois, code, coder, mean, soft=False)
    overlap = torch.as_tensor(iou_3d_aligned(refined, boxes))
    # Clamping (1 mm of bins, 1 mrad of heading) is all that may be lost; headings off by over 45 degrees are folded.
    within = (refined[:, 6] - boxes[:, 6]).sin().abs() < 0.01
    assert within.double().mean() > 0.95
    assert overlap[within].min() > 0.99


def test_roi_labels() -> None:
    iou = torch.tensor([0.61, 0.6, 0.59, 0.46, 0.45, 0.2, 0.9])
    empty = torch.tensor([False] * 6 + [True])
    assert classification_labels(iou, empty).tolist() == [1, 0, -1, -1, 0, 0, -1]
    assert soft_labels(torch.tensor([0.1, 0.25, 0.5, 0.75, 0.9])).tolist() == [0, 0, 0.5, 1, 1]
