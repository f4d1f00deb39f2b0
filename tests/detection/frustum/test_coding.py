from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from detection.frustum.coding import CLUSTERS, decode_heading, decode_size, encode_heading, encode_size
from detection.frustum.losses import FrustumTargets, centred_corners, frustum_losses, huber
from detection.frustum.network import FrustumOutput

CAR = (3.88311640418, 1.62856739989, 1.52563191462)


@given(st.floats(-20, 20))
def test_headings_come_back(angle: float) -> None:
    bins, residual = encode_heading(np.array([angle]))
    assert 0 <= bins[0] < 12
    assert abs(residual[0]) <= np.pi / 12 + 1e-9
    turn = decode_heading(bins, residual)[0] - angle
    assert abs(turn - 2 * np.pi * round(turn / (2 * np.pi))) < 1e-6


def test_heading_bins_by_hand() -> None:
    bins, residual = encode_heading(np.radians([0.0, 14.0, 16.0, -16.0, 180.0, 345.0]))
    assert bins.tolist() == [0, 0, 1, 11, 6, 0]
    np.testing.assert_allclose(np.degrees(residual), [0, 14, -14, 14, 0, -15], atol=1e-9)
    assert np.degrees(decode_heading(np.array([11]), np.array([0.0])))[0] == pytest.approx(-30)


def test_sizes_come_back() -> None:
    size, clusters = np.array([[4.0, 1.7, 1.5], [0.8, 0.6, 1.8]]), np.array([0, 3])
    residual = encode_size(size, clusters)
    np.testing.assert_allclose(residual[0], np.array([4.0, 1.7, 1.5]) - CAR)
    np.testing.assert_allclose(decode_size(clusters, residual), size)
    assert [CLUSTERS.index(name) for name in ("Car", "Pedestrian", "Cyclist")] == [0, 3, 5]


def test_huber_by_hand() -> None:
    assert float(huber(torch.tensor([0.5]), 1.0)) == pytest.approx(0.125)
    assert float(huber(torch.tensor([-3.0]), 2.0)) == pytest.approx(4.0)
    assert float(huber(torch.tensor([0.5, -3.0]), 2.0)) == pytest.approx((0.125 + 4) / 2)


def test_corners_turn_as_headings_do() -> None:
    corners = centred_corners(torch.zeros(1, 3), torch.tensor([np.pi / 2]), torch.tensor([[4.0, 2.0, 1.0]]))[0]
    assert sorted({round(float(x), 4) for x in corners[:, 0]}) == [-1, 1]
    assert sorted({round(float(z), 4) for z in corners[:, 2]}) == [-2, 2]
    assert sorted({round(float(y), 4) for y in corners[:, 1]}) == [-0.5, 0.5]
    front = centred_corners(torch.zeros(1, 3), torch.zeros(1), torch.tensor([[4.0, 2.0, 1.0]]))[0]
    # A quarter turn about y (down) takes the front, +x, to -z.
    np.testing.assert_allclose(corners[:, 2], -front[:, 0], atol=1e-6)


def perfect(target_heading: float = 0.1) -> tuple[FrustumOutput, FrustumTargets]:
    """One frustum of four points, of which the network is sure and right; sizes are exactly the mean."""
    box = torch.zeros(1, 59)
    box[0, :3] = torch.tensor([0.5, 0.0, 0.0])
    box[0, 3 + 1] = 50.0
    box[0, 15 + 1] = target_heading / (np.pi / 12)
    box[0, 27] = 50.0
    mask = torch.tensor([[1, 0, 0, 1]])
    logits = torch.where(mask[..., None] == torch.tensor([0, 1]), 40.0, -40.0)
    first = torch.tensor([[1.0, 0.0, 10.0]])
    output = FrustumOutput(logits, mask > 0, first, first, box)
    centre = torch.tensor([[1.5, 0.0, 10.0]])
    zero = torch.zeros(1, dtype=torch.int64)
    return output, FrustumTargets(mask, centre, zero + 1, torch.tensor([target_heading]), zero, torch.zeros(1, 3))


def test_losses_by_hand() -> None:
    output, target = perfect()
    losses = frustum_losses(output, target, "tf")
    # The first centre is 0.5 m away: 0.5 ^ 2 / 2; everything else is right.
    assert {name: round(float(value), 5) for name, value in losses.items() if name != "loss"} == {
        "segmentation": 0.0,
        "centre": 0.0,
        "heading_class": 0.0,
        "size_class": 0.0,
        "heading": 0.0,
        "size": 0.0,
        "first_centre": 0.125,
        "corners": 0.0,
    }
    output.box[0, 15 + 1] += 0.5
    assert float(frustum_losses(output, target, "tf")["heading"]) == pytest.approx(20 * 0.125, rel=1e-4)


def test_first_centre_is_compared_as_the_variant_says() -> None:
    output, target = perfect()
    output.box[0, :3] = torch.tensor([3.0, 0.0, 0.0])
    losses = {variant: frustum_losses(output, target, variant) for variant in ("tf", "port")}
    assert float(losses["tf"]["first_centre"]) == pytest.approx(0.125)  # 0.5 m to the truth
    assert float(losses["port"]["first_centre"]) == pytest.approx(2.5)  # 3 m to its own final centre
    # Huber with delta 2 of 2.5 m.
    assert float(losses["tf"]["centre"]) == pytest.approx(2 * (2.5 - 1))


def test_corners_take_the_size_residual_twice_and_either_direction() -> None:
    output, target = perfect()
    units = 27 + 8
    output.box[0, units + 2] = 0.1 / CAR[2]  # 0.1 m higher: as corners 0.2 m, a tenth of which each way
    assert float(frustum_losses(output, target, "tf")["corners"]) == pytest.approx(10 * 0.1**2 / 2, rel=1e-4)
    assert float(frustum_losses(output, target, "tf")["size"]) == pytest.approx(20 * (0.1 / CAR[2]) ** 2 / 2, rel=1e-4)
    straight, same = perfect()
    opposite = FrustumTargets(same.mask, same.centre, same.bins + 6, same.heading, same.clusters, same.size)
    straight.box[0, 15 + 7] = straight.box[0, 15 + 1]
    assert float(frustum_losses(straight, opposite, "tf")["corners"]) == pytest.approx(0, abs=1e-4)


def test_losses_have_finite_gradients_where_all_is_right() -> None:
    output, target = perfect()
    box = output.box.clone().requires_grad_()
    moved = FrustumOutput(output.logits, output.mask, output.mean, output.first_centre, box)
    frustum_losses(moved, target, "port")["loss"].backward()
    assert box.grad is not None
    assert bool(torch.isfinite(box.grad).all())
