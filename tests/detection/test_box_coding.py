"""Bin and residual codes against numbers worked out by hand, and there and back again."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from detection.models.box_coding import (
    MEAN_SIZES,
    boxes_from_points,
    boxes_from_rois,
    decode_point_residual,
    decode_residual,
    encode_residual,
    rcnn_coder,
    rotate_y,
    rpn_coder,
    to_roi_frame,
)
from tests.reference.box_codes import perfect_code

CAR = torch.tensor(MEAN_SIZES["Car"], dtype=torch.float64)


def test_code_lengths_are_those_of_the_checkpoints() -> None:
    assert (rpn_coder(True).channels, rpn_coder(False).channels, rcnn_coder().channels) == (76, 52, 46)
    # Where the y offset and the sizes begin (76: 48 and 73; 46: 24 and 43).
    fine, second = rpn_coder(True).block_sizes, rcnn_coder().block_sizes
    assert (sum(fine[:4]), sum(fine[:7]), sum(second[:4]), sum(second[:7])) == (48, 73, 24, 43)


def test_location_targets_by_hand() -> None:
    # 0.6 + 3 = 3.6 -> bin 7 (3.5..4), centre 3.75, residual -0.15 / 0.5; outside the scope the last bin's edge counts.
    index, residual = rpn_coder().encode_location(torch.tensor([0.6, -3.5, 9.0], dtype=torch.float64))
    assert index.tolist() == [7, 0, 11]
    torch.testing.assert_close(residual, torch.tensor([-0.3, -0.5, 0.498], dtype=torch.float64))


def test_heading_targets_by_hand() -> None:
    # Full circle, 30 degrees per bin, bin 0 about 0: 40 degrees -> bin 1 (15..45), 10 of 15 degrees off its centre.
    degrees = torch.tensor([40.0, -10.0, 180.0], dtype=torch.float64)
    index, residual = rpn_coder().encode_heading(degrees.deg2rad())
    assert index.tolist() == [1, 0, 6]
    torch.testing.assert_close(residual, torch.tensor([10 / 15, -10 / 15, 0.0], dtype=torch.float64))
    # Folded: 190 degrees counts as 10; +45 gives 55 -> bin 5 (50..60), at its centre. 80 is clamped to +45.
    index, residual = rcnn_coder().encode_heading(torch.tensor([190.0, 10.0, 80.0], dtype=torch.float64).deg2rad())
    assert index.tolist() == [5, 5, 8]
    torch.testing.assert_close(residual[:2], torch.zeros(2, dtype=torch.float64), atol=1e-9, rtol=0)
    assert residual[2].item() == pytest.approx(1 - 1e-3 / math.radians(5))


def test_hard_and_soft_decoding_differ_as_described() -> None:
    coder = rpn_coder()
    code = torch.zeros(1, 76, dtype=torch.float64)
    code[0, 5], code[0, 6] = math.log(3), math.log(1)  # x bins 5 and 6, weights 3 : 1 among ones
    code[0, 24 + 5], code[0, 48] = 0.2, 0.7
    hard = coder.decode(code, CAR, soft=False)[0][0]
    soft = coder.decode(code, CAR, soft=True)[0][0]
    # Bin 5 is centred at -0.25; 0.2 bins are 0.1 m. Soft: sum of all centres is 0, bin 5 counts twice more.
    assert hard.tolist() == pytest.approx([-0.15, 0.7, -2.75])
    assert soft.tolist() == pytest.approx([(2 * -0.25 + 3 * 0.1) / 14, 0.7, 0.0])


def test_soft_decoding_needs_residuals() -> None:
    with pytest.raises(ValueError, match="residuals per bin"):
        rpn_coder(False).decode(torch.zeros(1, 52), CAR.float(), soft=True)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(-2.9, 2.9), min_size=3, max_size=3),
    st.lists(st.floats(0.4, 6.0), min_size=3, max_size=3),
    st.floats(-math.pi, math.pi),
    st.booleans(),
)
def test_first_stage_code_returns_the_box(offsets, sizes, ry, soft) -> None:
    coder = rpn_coder()
    point = torch.tensor([[3.0, 1.0, 20.0]], dtype=torch.float64)
    box = torch.tensor(
        [[3 + offsets[0], 1 + offsets[1] + sizes[0] / 2, 20 + offsets[2], *sizes, ry]], dtype=torch.float64
    )
    centre = box[:, :3] - torch.tensor([0, 0.5, 0], dtype=torch.float64) * box[:, 3:4]
    code = perfect_code(coder, coder.encode(centre - point, box[:, 3:6], box[:, 6], CAR))
    again = boxes_from_points(point, code, coder, CAR, soft)
    torch.testing.assert_close(again[:, :6], box[:, :6], atol=1e-6, rtol=0)
    assert math.cos(again[0, 6].item() - ry) == pytest.approx(1.0)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(-1.4, 1.4), min_size=2, max_size=2),
    st.floats(-0.7, 0.7),
    st.floats(-math.pi, math.pi),
    st.floats(-0.75, 0.75),
    st.booleans(),
)
def test_second_stage_code_returns_the_box(offsets, dy, roi_ry, turn, soft) -> None:
    coder = rcnn_coder()
    roi = torch.tensor([[5.0, 1.5, 25.0, 1.5, 1.6, 4.0, roi_ry]], dtype=torch.float64)
    local = torch.tensor([[offsets[0], dy, offsets[1]]], dtype=torch.float64)
    bottom = roi[:, :3] + rotate_y(local, roi[:, 6])
    truth = torch.cat([bottom, torch.tensor([[1.6, 1.7, 4.4, roi_ry + turn]], dtype=torch.float64)], dim=1)
    seen = to_roi_frame(truth, roi)
    code = perfect_code(coder, coder.encode(seen[:, :3], seen[:, 3:6], seen[:, 6], CAR))
    torch.testing.assert_close(boxes_from_rois(roi, code, coder, CAR, soft), truth, atol=1e-6, rtol=0)


def test_opposite_heading_is_folded() -> None:
    coder = rcnn_coder()
    roi = torch.tensor([[0.0, 1.5, 10.0, 1.5, 1.6, 4.0, 0.3]], dtype=torch.float64)
    truth = roi.clone()
    truth[:, 6] += math.pi - 0.2
    seen = to_roi_frame(truth, roi)
    code = perfect_code(coder, coder.encode(seen[:, :3], seen[:, 3:6], seen[:, 6], CAR))
    assert boxes_from_rois(roi, code, coder, CAR, True)[0, 6].item() == pytest.approx(0.3 - 0.2)


def test_rotation_has_the_sign_of_kitti() -> None:
    # ry = pi/2 takes a box's length (+x) to -z of the scene.
    turned = rotate_y(torch.tensor([[1.0, 2.0, 0.0]]), torch.tensor([math.pi / 2]))
    torch.testing.assert_close(turned, torch.tensor([[0.0, 2.0, -1.0]]), atol=1e-6, rtol=0)


def test_residual_code_by_hand_and_back() -> None:
    anchor = torch.tensor([[1.0, 2.0, -1.0, 3.0, 4.0, 2.0, 0.5]], dtype=torch.float64)  # diagonal 5
    box = torch.tensor([[2.0, 1.0, -0.5, 3.0 * math.e, 4.0, 1.0, 0.7]], dtype=torch.float64)
    code = encode_residual(box, anchor)
    assert code[0].tolist() == pytest.approx([0.2, -0.2, 0.25, 1.0, 0.0, -math.log(2), 0.2])
    torch.testing.assert_close(decode_residual(code, anchor), box)


def test_point_residual_by_hand() -> None:
    mean = torch.tensor([[3.0, 4.0, 2.0]], dtype=torch.float64)
    code = torch.tensor([[0.2, -0.2, 0.25, 0.0, math.log(2), 0.0, 0.0, -2.0]], dtype=torch.float64)
    box = decode_point_residual(torch.tensor([[10.0, 1.0, -1.0]], dtype=torch.float64), code, mean)
    assert box[0].tolist() == pytest.approx([11.0, 0.0, -0.5, 3.0, 8.0, 2.0, -math.pi / 2])
