"""Anchors, their targets and losses; numbers worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F

from detection.models.anchor_head import CAR, KITTI_ANCHORS, AnchorHead, HeadOutput, make_anchors, match_anchors
from detection.models.box_coding import encode_residual
from detection.models.lidar_boxes import limit_period, nearest_bev_iou

LOW, HIGH = (0.0, -4.0, -3.0), (8.0, 4.0, 1.0)


def box(x: float, y: float, heading: float, size: tuple[float, float, float] = (3.9, 1.6, 1.56)) -> list[float]:
    return [x, y, -1.0, *size, heading]


def head() -> AnchorHead:
    torch.manual_seed(0)
    return AnchorHead(4, KITTI_ANCHORS, LOW, HIGH, (5, 3))


def test_anchors_lie_on_the_borders_and_run_class_by_class() -> None:
    anchors = make_anchors(KITTI_ANCHORS, LOW, HIGH, (5, 3)).view(5, 3, 3, 2, 7)
    assert anchors[0, 0, 0, 0].tolist() == pytest.approx([0, -4, -1.0, 3.9, 1.6, 1.56, 0], abs=1e-6)
    assert anchors[4, 2, 0, 1].tolist() == pytest.approx([8, 4, -1.0, 3.9, 1.6, 1.56, 1.57], abs=1e-6)
    assert anchors[1, 2, 1, 0].tolist() == pytest.approx([8, -2, 0.265, 0.8, 0.6, 1.73, 0], abs=1e-6)
    assert anchors[0, 1, 2, 1].tolist() == pytest.approx([4, -4, 0.265, 1.76, 0.6, 1.73, 1.57], abs=1e-6)


def test_nearest_bev_iou_turns_boxes_to_the_nearest_axis() -> None:
    along, across = box(0, 0, 0, (4, 2, 1)), box(0, 0, 1.57, (4, 2, 1))
    tilted, shifted = box(0, 0, math.pi + 0.5, (4, 2, 1)), box(2, 0, 0, (4, 2, 1))
    found = nearest_bev_iou(torch.tensor([along]), torch.tensor([along, across, tilted, shifted]))
    assert found[0].tolist() == pytest.approx([1, 4 / 12, 1, 4 / 12])


def test_matching_by_thresholds_and_by_force() -> None:
    # Shifts along a length of 4 give IoU (4 - s) / (4 + s): 1, 0.6, 0.4545, 0.4286.
    anchors = torch.tensor([box(shift, 0, 0, (4, 2, 1)) for shift in (0.0, 1.0, 1.5, 1.6)])
    truth = torch.tensor([box(0, 0, 0, (4, 2, 1))])
    assert match_anchors(anchors, truth, 2, 0.6, 0.45).labels.tolist() == [2, 2, -1, 0]
    # Nothing reaches 0.6, but the best anchor is positive all the same; a box that no anchor meets forces nothing.
    far = torch.tensor([box(3.6, 0, 0, (4, 2, 1)), box(50, 0, 0, (4, 2, 1))])
    found = match_anchors(anchors, far, 1, 0.6, 0.45)
    assert found.labels.tolist() == [0, 0, 0, 1]
    assert found.boxes[3].tolist() == far[0].tolist()
    ties = torch.tensor([box(-2, 0, 0, (4, 2, 1)), box(2, 0, 0, (4, 2, 1))])
    assert match_anchors(ties, truth, 1, 0.6, 0.45).labels.tolist() == [1, 1]
    assert match_anchors(anchors, truth[:0], 1, 0.6, 0.45).labels.tolist() == [0, 0, 0, 0]


def test_anchors_see_only_boxes_of_their_class() -> None:
    model = head()
    truth = torch.tensor([box(4, 0, 0.1)])
    for label in (1, 2, 3):
        found = model.targets(truth, torch.tensor([label])).labels.view(5, 3, 3, 2)
        positive = (found > 0).nonzero()
        assert set(found[found > 0].tolist()) == {label}
        assert set(positive[:, 2].tolist()) == {label - 1}


def perfect(model: AnchorHead, truth: torch.Tensor, labels: torch.Tensor, extra_turn: float = 0.0) -> HeadOutput:
    """The output of a network that knows the targets."""
    targets = model.targets(truth, labels)
    positive = targets.labels > 0
    code = torch.zeros(len(model.anchors), 7)
    code[positive] = encode_residual(targets.boxes[positive], model.anchors[positive])
    code[positive, 6] += extra_turn
    cls = F.one_hot(targets.labels.clamp(min=0), 4)[:, 1:].float() * 40 - 20
    side = (limit_period(targets.boxes[:, 6] - 0.78539, 0.0, 2 * math.pi) / math.pi).floor().long()
    return HeadOutput(cls[None], code[None], F.one_hot(side, 2).float()[None] * 40 - 20)


@pytest.mark.parametrize("heading", [-3.0, -1.6, -0.7, 0.0, 0.9, 2.2, 3.1])
def test_a_perfect_output_costs_nothing_and_decodes_to_the_truth(heading) -> None:
    model = head()
    truth, labels = torch.tensor([box(4.2, 0.3, heading)]), torch.tensor([1])
    out = perfect(model, truth, labels)
    losses = model.losses(out, [truth], [labels])
    assert all(float(value) == pytest.approx(0, abs=1e-5) for value in losses.values())
    positive = model.targets(truth, labels).labels > 0
    decoded = model.decode(out)[0, positive]
    turn = limit_period(decoded[:, 6] - heading, 0.5, 2 * math.pi)
    torch.testing.assert_close(decoded[:, :6], truth[:, :6].expand(len(decoded), -1), rtol=1e-4, atol=1e-4)
    assert float(turn.abs().max()) < 1e-4


def test_box_loss_by_hand_and_blind_to_half_a_turn() -> None:
    model = head()
    truth, labels = torch.tensor([box(4.2, 0.3, 0.4)]), torch.tensor([1])
    # Smooth L1 with its kink at 1/9 of sin(0.3), times 2, for every positive alike.
    turned = model.losses(perfect(model, truth, labels, 0.3), [truth], [labels])
    assert float(turned["anchor_box"]) == pytest.approx(2 * (math.sin(0.3) - 1 / 18), rel=1e-4)
    opposite = model.losses(perfect(model, truth, labels, math.pi), [truth], [labels])
    assert float(opposite["anchor_box"]) == pytest.approx(0, abs=1e-5)


def test_uncertain_classes_and_directions_by_hand() -> None:
    model = head()
    truth, labels = torch.tensor([box(4.2, 0.3, 0.4)]), torch.tensor([1])
    count = len(model.anchors)
    out = HeadOutput(torch.zeros(1, count, 3), torch.zeros(1, count, 7), torch.zeros(1, count, 2))
    losses = model.losses(out, [truth], [labels])
    found = model.targets(truth, labels).labels
    positives, cared = int((found > 0).sum()), int((found >= 0).sum())
    assert positives > 0
    # Focal loss at probability one half: a quarter of log 2, times 0.25 for a one and 0.75 for a zero.
    ones, zeros = positives, 3 * cared - positives
    expected = (0.25 * ones + 0.75 * zeros) * 0.25 * math.log(2) / positives
    assert float(losses["anchor_class"]) == pytest.approx(expected, rel=1e-5)
    assert float(losses["anchor_direction"]) == pytest.approx(0.2 * math.log(2), rel=1e-5)
    # Frames count alike, whatever their numbers of anchors; one without boxes is divided by 1.
    both = HeadOutput(*(torch.cat([value, value]) for value in (out.cls, out.box, out.direction)))
    mixed = model.losses(both, [truth, truth[:0]], [labels, labels[:0]])
    empty = 3 * count * 0.75 * 0.25 * math.log(2)
    assert float(mixed["anchor_class"]) == pytest.approx((expected + empty) / 2, rel=1e-5)


def test_a_map_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="expected a map for 90 anchors"):
        head()(torch.zeros(1, 4, 3, 5 + 1))
    assert CAR.bottom + CAR.size[2] / 2 == pytest.approx(-1.0)
