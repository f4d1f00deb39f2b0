"""Losses by hand and against the twin in plain Python."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from detection.losses import (
    aligned_iou,
    bin_box_loss,
    box_corners,
    consistency_loss,
    corner_loss,
    dice_loss,
    foreground_loss,
    iou_branch_loss,
    masked_bce,
    sigmoid_focal,
    smooth_l1,
    weighted_bce,
)
from detection.models.box_coding import MEAN_SIZES, rcnn_coder, rpn_coder
from tests.reference import detection_losses as twin
from tests.reference.box_codes import perfect_code

CAR = torch.tensor(MEAN_SIZES["Car"], dtype=torch.float64)


def test_focal_loss_by_hand() -> None:
    # p = 0.5: 0.25 * 0.25 * ln 2 for a positive, 0.75 * 0.25 * ln 2 for a negative.
    loss = sigmoid_focal(torch.zeros(2, dtype=torch.float64), torch.tensor([1.0, 0.0], dtype=torch.float64))
    assert loss.tolist() == pytest.approx([0.0625 * math.log(2), 0.1875 * math.log(2)])


def test_foreground_loss_ignores_the_ring_and_divides_by_positives() -> None:
    logits = torch.zeros(1, 5, 1, dtype=torch.float64)
    loss = foreground_loss(logits, torch.tensor([[1, 1, 0, -1, -1]]))
    assert loss.item() == pytest.approx((2 * 0.0625 + 0.1875) * math.log(2) / 2)
    assert foreground_loss(logits, torch.tensor([[0, 0, -1, -1, -1]])).item() == pytest.approx(2 * 0.1875 * math.log(2))


def test_foreground_loss_of_several_classes() -> None:
    # A point of class 2 is a negative for class 1.
    loss = foreground_loss(torch.zeros(1, 1, 2, dtype=torch.float64), torch.tensor([[2]]))
    assert loss.item() == pytest.approx((0.0625 + 0.1875) * math.log(2))


@pytest.mark.parametrize(
    ("coder", "scope", "heading", "folded"), [(rpn_coder(), 3.0, 12, False), (rcnn_coder(), 1.5, 9, True)]
)
def test_box_and_consistency_losses_agree_with_the_twin(coder, scope, heading, folded, rng) -> None:
    codes = rng.normal(0, 0.7, (20, coder.channels))
    boxes = np.column_stack([rng.uniform(-1.7, 1.7, (20, 3)), rng.uniform(1, 5, (20, 3)), rng.uniform(-4, 4, 20)])
    logits = rng.normal(0, 2, 20)
    code, box = torch.tensor(codes), torch.tensor(boxes)
    targets = coder.encode(box[:, :3], box[:, 3:6], box[:, 6], CAR)
    expected = np.mean([twin.box_loss(list(c), list(b), scope, heading, folded) for c, b in zip(codes, boxes)])
    assert bin_box_loss(code, targets, coder).total().item() == pytest.approx(expected, rel=1e-9)
    ours = consistency_loss(torch.tensor(logits), code, targets, box[:, 3:6], CAR, coder)
    rows = zip(logits, codes, boxes)
    expected = np.mean([twin.consistency(logit, list(c), list(b), scope, heading) for logit, c, b in rows])
    assert ours.item() == pytest.approx(expected, rel=1e-9)


def test_only_the_target_bin_of_a_residual_learns() -> None:
    coder = rpn_coder()
    code = torch.zeros(1, 76, dtype=torch.float64, requires_grad=True)
    box = torch.tensor([[0.6, 0.0, -1.1, 1.5, 1.6, 4.0, 0.4]], dtype=torch.float64)
    bin_box_loss(code, coder.encode(box[:, :3], box[:, 3:6], box[:, 6], CAR), coder).total().backward()
    assert code.grad is not None
    assert torch.nonzero(code.grad[0, 24:48]).flatten().tolist() == [7, 12 + 3]
    assert torch.nonzero(code.grad[0, 61:73]).flatten().tolist() == [1]


def test_consistency_gradient_reaches_score_centre_and_size() -> None:
    coder = rpn_coder()
    generator = torch.Generator().manual_seed(1)
    code = (torch.randn(3, 76, generator=generator, dtype=torch.float64) * 0.1).requires_grad_()
    logits = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    box = torch.tensor([[0.4, 0.1, -0.3, 1.4, 1.5, 4.2, 0.4]], dtype=torch.float64).repeat(3, 1)
    targets = coder.encode(box[:, :3], box[:, 3:6], box[:, 6], CAR)
    consistency_loss(logits, code, targets, box[:, 3:6], CAR, coder).backward()
    assert code.grad is not None
    assert logits.grad is not None
    assert bool((logits.grad != 0).all())
    for block, touched in zip(coder.split(code.grad), (True, True, True, True, True, False, False, True)):
        assert bool((block != 0).any()) is touched


def test_losses_without_foreground_are_zero_and_differentiable() -> None:
    coder = rcnn_coder()
    code = torch.zeros(0, 46, requires_grad=True)
    empty = torch.zeros(0, 3)
    targets = coder.encode(empty, empty, torch.zeros(0), CAR.float())
    total = bin_box_loss(code, targets, coder).total()
    total = total + consistency_loss(torch.zeros(0), code, targets, empty, CAR.float(), coder)
    total.backward()
    assert total.item() == 0


def test_masked_bce_leaves_ignored_labels_out() -> None:
    logits = torch.tensor([0.0, 100.0, 0.0], dtype=torch.float64)
    assert masked_bce(logits, torch.tensor([1.0, -1.0, 0.0])).item() == pytest.approx(math.log(2))
    assert masked_bce(logits, torch.tensor([-1.0, -1.0, -1.0])).item() == 0


def test_smooth_l1_by_hand() -> None:
    # Below beta 1/9: 4.5 x^2; above: |x| - 1/18.
    loss = smooth_l1(torch.tensor([0.1, -0.5], dtype=torch.float64))
    assert loss.tolist() == pytest.approx([0.045, 0.5 - 1 / 18])


def test_corner_loss_sees_a_half_turn_as_no_error() -> None:
    box = torch.tensor([[2.0, 1.0, 15.0, 1.5, 1.6, 4.0, 0.3]], dtype=torch.float64)
    turned, lifted = box.clone(), box.clone()
    turned[:, 6] += math.pi
    lifted[:, 1] -= 0.5
    assert corner_loss(turned, box).item() == pytest.approx(0, abs=1e-12)
    assert corner_loss(lifted, box).item() == pytest.approx(0.125)


def test_corners_match_the_devkit_order() -> None:
    from detection.boxes import corners
    from detection.types import Boxes3D

    box = np.array([[2.0, 1.0, 15.0, 1.5, 1.6, 4.0, 0.3]])
    np.testing.assert_allclose(box_corners(torch.tensor(box)).numpy(), corners(Boxes3D(box)), atol=1e-12)


def test_the_iou_branch_learns_the_aligned_iou_without_headings() -> None:
    # A car 1 m off along x with a wrong heading: 3 x 1.5 x 2 m of 4 x 1.5 x 2 m shared, IoU 9 / (12 + 12 - 9) = 0.6.
    coder = rcnn_coder()
    mean = torch.tensor([1.5, 2.0, 4.0], dtype=torch.float64)
    box = torch.tensor([[0.25, 0.0, 0.25, 1.5, 2.0, 4.0, 0.5]], dtype=torch.float64)
    wrong = box + torch.tensor([[1.0, 0, 0, 0, 0, 0, -0.5]], dtype=torch.float64)
    targets = coder.encode(box[:, :3], box[:, 3:6], box[:, 6], mean)
    code = perfect_code(coder, coder.encode(wrong[:, :3], wrong[:, 3:6], wrong[:, 6], mean)).requires_grad_()
    iou = aligned_iou(code, targets, box[:, 3:6], mean, coder)
    assert iou.tolist() == pytest.approx([0.6])
    raw = torch.tensor([0.25], dtype=torch.float64, requires_grad=True)
    loss = iou_branch_loss(raw, iou)
    assert loss.item() == pytest.approx(-0.6 * math.log(0.25) - 0.4 * math.log(0.75))
    loss.backward()
    assert raw.grad is not None
    assert code.grad is None
    # No sigmoid: what lies outside [1e-4, 0.9999] is clamped.
    assert iou_branch_loss(raw.detach() - 3, iou).item() == pytest.approx(-0.6 * math.log(1e-4), rel=1e-3)


def _logits(probabilities: list[float]) -> torch.Tensor:
    return torch.tensor([probabilities], dtype=torch.float64).logit().requires_grad_()


def test_dice_loss_by_hand() -> None:
    # Shared 0.8 + 0 (minima), union 1 + 0.5 (maxima); the ignored point counts in neither: 1 - 0.8 / 1.5.
    logits = _logits([0.8, 0.5, 0.9])
    loss = dice_loss(logits, torch.tensor([[1, 0, -1]]))
    assert loss.item() == pytest.approx(1 - 0.8 / 1.5)
    loss.backward()
    assert logits.grad is not None
    # d/dp: -1 / 1.5 and +0.8 / 1.5^2; dp/dlogit = p (1 - p).
    assert logits.grad[0].tolist() == pytest.approx([-0.16 / 1.5, 0.25 * 0.8 / 2.25, 0])
    # A union below one counts as one.
    assert dice_loss(_logits([0.25, 0.5]), torch.tensor([[0, 0]])).item() == 1
    assert dice_loss(_logits([0.25])[..., None], torch.tensor([[-1]])).item() == 1


def test_weighted_bce_by_hand() -> None:
    # 15 times -ln 0.8 and once -ln(1 - 0.5), over two points.
    logits = _logits([0.8, 0.5, 0.9])
    loss = weighted_bce(logits[..., None], torch.tensor([[1, 0, -1]]))
    assert loss.item() == pytest.approx((-15 * math.log(0.8) - math.log(0.5)) / 2)
    loss.backward()
    assert logits.grad is not None
    assert logits.grad[0].tolist() == pytest.approx([15 * (0.8 - 1) / 2, 0.5 / 2, 0])
    assert weighted_bce(logits, torch.tensor([[-1, -1, -1]])).item() == 0


def test_the_raw_iou_takes_the_residuals_of_the_target_bins() -> None:
    # All bins alike: the expectation is 0, the target bins' centres are 0.25. A perfect size and a residual of half a
    # bin put the box 0.25 m off along x: 3.75 of 4 m shared, IoU 3.75 / 4.25.
    coder = rcnn_coder()
    mean = torch.tensor([1.5, 2.0, 4.0], dtype=torch.float64)
    box = torch.tensor([[0.25, 0.0, 0.25, 1.5, 2.0, 4.0, 0.0]], dtype=torch.float64)
    targets = coder.encode(box[:, :3], box[:, 3:6], box[:, 6], mean)
    code = torch.zeros(1, coder.channels, dtype=torch.float64)
    code[0, 12 + 3] = 0.5  # x residual of the bin [0, 0.5) m
    code.requires_grad_()
    logits = torch.zeros(1, dtype=torch.float64)
    loss = consistency_loss(logits, code, targets, box[:, 3:6], mean, coder, raw=True)
    assert loss.item() == pytest.approx(-math.log(0.5 * 3.75 / 4.25))
    assert consistency_loss(logits, code, targets, box[:, 3:6], mean, coder).item() != pytest.approx(loss.item())
    loss.backward()
    assert code.grad is not None
    x_bin, z_bin, x_res, *_ = coder.split(code.grad)
    assert not x_bin.any()
    assert not z_bin.any()
    # d IoU / dx = -(w h (V + V)) / (V + V - I)^2 with V = 12, I = 11.25, w h = 3: -72 / 12.75^2; 0.5 m per residual.
    assert x_res[0].tolist() == pytest.approx([0, 0, 0, 0.5 * 72 / 12.75**2 * 4.25 / 3.75, 0, 0])
