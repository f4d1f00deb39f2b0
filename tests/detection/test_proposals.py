"""The proposal layer: budgets, bands, padding."""

from __future__ import annotations

import pytest
import torch

from detection.models.proposals import ProposalSettings, near_far_budget, propose, select_proposals


def spread_boxes(z: list[float]) -> torch.Tensor:
    """One car-sized box per depth, none overlapping another."""
    boxes = torch.tensor([[0.0, 1.5, 0.0, 1.5, 1.6, 3.9, 0.0]]).repeat(len(z), 1)
    boxes[:, 0] = torch.arange(len(z)) * 10.0
    boxes[:, 2] = torch.tensor(z)
    return boxes


@pytest.mark.parametrize(
    ("total", "near"), [(9000, 6300), (12000, 8400), (8000, 5600), (512, 358), (300, 210), (100, 70), (64, 44)]
)
def test_budgets_of_the_two_bands(total, near) -> None:
    assert near_far_budget(total) == (near, total - near)


def test_bands_are_cut_separately_and_near_comes_first() -> None:
    boxes = spread_boxes([10, 50, 20, 60, 30, 40, 40.1, 80, 80.1, 0, -1])
    scores = torch.tensor([0.1, 0.9, 0.2, 0.8, 0.3, 0.4, 0.7, 0.6, 0.99, 0.98, 0.97])
    settings = ProposalSettings(before=10, after=4, iou=0.8, by_distance=True, rotated=False)
    # 4 -> 2 near and 2 far; z = 40 is near, 80 is far, 0 and 80.1 vanish.
    assert select_proposals(boxes, scores, settings).tolist() == [5, 4, 1, 3]


def test_an_empty_far_band_takes_the_next_near_proposals() -> None:
    boxes = spread_boxes([5.0 + k for k in range(10)])
    scores = torch.arange(10, 0, -1).float()
    settings = ProposalSettings(before=6, after=6, iou=0.8, by_distance=True, rotated=False)
    # 4 near, then 2 of ranks 4 and 5 in place of far ones.
    assert select_proposals(boxes, scores, settings).tolist() == [0, 1, 2, 3, 4, 5]


def test_an_empty_near_band_is_no_error() -> None:
    settings = ProposalSettings(before=10, after=4, iou=0.8, by_distance=True, rotated=False)
    assert select_proposals(spread_boxes([50, 60]), torch.tensor([1.0, 2.0]), settings).tolist() == [1, 0]
    assert select_proposals(spread_boxes([-5, 90]), torch.tensor([1.0, 2.0]), settings).tolist() == []


def test_unrotated_suppression_lays_the_length_along_x() -> None:
    # Two cars side by side in z, both heading +-90 degrees: rotated they are apart, unrotated they overlap.
    boxes = torch.tensor([[0.0, 1.5, 10.0, 1.5, 1.6, 4.0, 1.5708], [2.0, 1.5, 10.0, 1.5, 1.6, 4.0, 1.5708]])
    scores = torch.tensor([1.0, 2.0])
    for rotated, kept in ((False, [1]), (True, [1, 0])):
        settings = ProposalSettings(before=10, after=4, iou=0.3, by_distance=False, rotated=rotated)
        assert select_proposals(boxes, scores, settings).tolist() == kept


def test_score_based_keeps_the_best_wherever_they_are() -> None:
    settings = ProposalSettings(before=3, after=2, iou=0.8, by_distance=False, rotated=True)
    boxes = spread_boxes([10, 50, 90, 20])
    assert select_proposals(boxes, torch.tensor([0.1, 0.5, 0.9, 0.2]), settings).tolist() == [2, 1]


def test_padding_is_marked() -> None:
    settings = ProposalSettings(before=10, after=4, iou=0.8, by_distance=False, rotated=True)
    boxes = spread_boxes([10, 20])[None].requires_grad_()
    found = propose(boxes, torch.tensor([[1.0, 2.0]]), settings)
    assert found.valid.tolist() == [[True, True, False, False]]
    assert found.index[0, :2].tolist() == [1, 0]
    assert (found.rois[0, 2:] == 0).all()
    assert found.scores[0].tolist() == [2, 1, 0, 0]
    assert not found.rois.requires_grad
