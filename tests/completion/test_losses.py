"""Losses against numbers worked out by hand, the thesis' identities, and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from completion import losses
from completion.analysis import expected_fusion_loss, expected_loss, smallest_gamma

errors = st.floats(-100, 100, allow_nan=False)
gammas = st.floats(1, 10)


def at(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def test_asymmetric_errors_by_hand() -> None:
    assert float(losses.ale(at(2.0), 2.5)) == 5.0  # too deep: gamma times
    assert float(losses.ale(at(-2.0), 2.5)) == pytest.approx(0.8)
    assert float(losses.rale(at(2.0), 2.5)) == pytest.approx(0.8)
    assert float(losses.rale(at(-2.0), 2.5)) == 5.0


@given(errors, gammas)
def test_identities_of_the_asymmetric_errors(error: float, gamma: float) -> None:
    assert float(losses.ale(at(error), 1.0)) == abs(error)
    assert float(losses.rale(at(error), gamma)) == float(losses.ale(at(-error), gamma))
    assert float(losses.rale(at(error), gamma)) == pytest.approx(float(losses.ale(at(error), 1 / gamma)), abs=1e-9)


@given(st.floats(0.05, 0.95))
def test_minimum_of_the_expected_error_moves_at_the_gamma_of_eq_4_4(p1: float) -> None:
    d1, d2 = 10.0, 13.0
    for gamma, foreground in ((smallest_gamma(p1) * 1.05, True), (smallest_gamma(p1) * 0.95, False)):
        ends = expected_loss(
            lambda e, g=gamma: losses.ale(e, g), torch.tensor([d1, d2]).double(), (d1, d2), (p1, 1 - p1)
        )
        assert bool(ends[0] < ends[1]) is foreground
        # Eq. 4.4's two values: p2 (d2 - d1) / gamma and p1 (d2 - d1) gamma
        assert ends.tolist() == pytest.approx([(1 - p1) * 3 / gamma, p1 * 3 * gamma])


def test_expected_fusion_loss_is_least_at_the_likelier_surface() -> None:
    sigma = np.linspace(0, 1, 101)
    assert sigma[expected_fusion_loss(sigma, 10, 30, 0.7).argmin()] == 1
    assert sigma[expected_fusion_loss(sigma, 10, 30, 0.3).argmin()] == 0


def test_twin_loss_by_hand() -> None:
    output = torch.zeros(1, 3, 1, 2)
    output[0, :, 0, 0] = torch.tensor([8.0, 14.0, 0.0])  # foreground 2 short, background 4 beyond, fused 11 for 10
    output[0, :, 0, 1] = torch.tensor([50.0, 50.0, 3.0])  # not valid
    target = torch.tensor([[[[10.0, 0.0]]]])
    found = losses.twin_loss(output, target, losses.valid_weights(target), gamma=2.0)
    assert float(found.foreground) == pytest.approx(1.0)
    assert float(found.background) == pytest.approx(2.0)
    assert float(found.fusion) == pytest.approx(1.0)
    assert float(found.total) == pytest.approx(4.0)


def test_mean_is_per_image_then_over_images() -> None:
    target = torch.tensor([[[[1.0, 1.0, 1.0, 1.0]]], [[[1.0, 0.0, 0.0, 0.0]]], [[[0.0, 0.0, 0.0, 0.0]]]])
    prediction = torch.tensor([[[[2.0, 1.0, 1.0, 1.0]]], [[[3.0, 9.0, 9.0, 9.0]]], [[[5.0, 5.0, 5.0, 5.0]]]])
    assert float(losses.l1(prediction, target, losses.valid_weights(target))) == pytest.approx((0.25 + 2 + 0) / 3)


def test_one_channel_losses_by_hand() -> None:
    target = torch.tensor([[[[1.0, 1.0, 0.0]]]])
    prediction = torch.tensor([[[[1.5, 4.0, 9.0]]]])
    weights = losses.valid_weights(target)
    assert float(losses.l1(prediction, target, weights)) == pytest.approx((0.5 + 3) / 2)
    assert float(losses.l2(prediction, target, weights)) == pytest.approx((0.25 + 9) / 2)
    assert float(losses.l1_l2(prediction, target, weights)) == pytest.approx((0.5 + 3 + 0.25 + 9) / 2)
    assert float(losses.huber(prediction, target, weights)) == pytest.approx((0.125 + 2.5) / 2)


@pytest.mark.parametrize("name", ["l1", "l2", "l1_l2", "huber", "twin", "sigma"])
def test_gradients_agree_with_finite_differences(name: str) -> None:
    generator = torch.Generator().manual_seed(1)
    channels = 3 if name in ("twin", "sigma") else 1
    output = torch.rand(2, channels, 3, 4, generator=generator, dtype=torch.float64) * 3
    output[:, 1:2] += 2 if channels == 3 else 0
    output.requires_grad_()
    target = torch.rand(2, 1, 3, 4, generator=generator, dtype=torch.float64) * 4
    weights = (torch.rand(target.shape, generator=generator) < 0.7).double()

    def loss(values: Tensor) -> Tensor:
        if name == "twin":
            return losses.twin_loss(values, target, weights, 2.0).total
        if name == "sigma":
            # Only sigma carries a gradient: hold the surfaces, as the loss does.
            return losses.sigma_loss(torch.cat((output[:, :2].detach(), values[:, 2:]), 1), target, weights, 0.5)
        return losses.DEPTH_LOSSES[name](values, target, weights)

    assert torch.autograd.gradcheck(loss, (output,))


def test_detached_surfaces_leave_fusion_to_sigma() -> None:
    output = torch.tensor([[[[4.0]], [[9.0]], [[0.5]]]], requires_grad=True)
    target = torch.full((1, 1, 1, 1), 6.0)
    ones = torch.ones_like(target)
    (through,) = torch.autograd.grad(losses.twin_loss(output, target, ones, 2.0).fusion, output)
    (cut,) = torch.autograd.grad(losses.twin_loss(output, target, ones, 2.0, detach_surfaces=True).fusion, output)
    assert through[0, :, 0, 0].abs().min() > 0
    assert cut[0, :2].abs().max() == 0
    assert cut[0, 2, 0, 0] == through[0, 2, 0, 0]


def test_sigma_loss_looks_at_ambiguous_pixels_only() -> None:
    target = torch.tensor([[[[10.0, 10.0, 30.0]]]])
    output = torch.tensor([[[[10.0, 10.0, 10.0]], [[30.0, 10.5, 30.0]], [[2.0, -9.0, 2.0]]]])
    found = losses.sigma_loss(output, target, losses.valid_weights(target), threshold=1.0)
    right, wrong = np.log1p(np.exp(-2.0)), np.log1p(np.exp(2.0))
    assert float(found) == pytest.approx((right + wrong) / 2, rel=1e-6)


@pytest.mark.parametrize(
    ("rule", "expected"),
    [("average", [15.0, 0.0]), ("minimum", [10.0, 0.0]), ("maximum", [20.0, 0.0]), ("nearest", [20.0, 0.0])],
)
def test_targets_of_lower_resolution(rule: str, expected: list[float]) -> None:
    target = torch.tensor([[[[0.0, 20.0, 0.0, 0.0], [10.0, 0.0, 0.0, 0.0]]]])
    assert losses.pool_target(target, 2, rule).flatten().tolist() == pytest.approx(expected)


def test_edges_and_rows_above_the_top_ring() -> None:
    target = torch.full((1, 1, 9, 9), 10.0)
    target[..., 5:] = 30.0
    edges = losses.depth_edges(target)[0, 0, 4].tolist()
    assert edges == [0, 0, 0, 1, 1, 1, 1, 0, 0]
    sparse = torch.zeros(2, 1, 6, 80)
    sparse[0, 0, 2, 10], sparse[0, 0, 4, 60] = 5.0, 5.0
    below = losses.below_top_ring(sparse)
    assert below[0, 0, :, 10].tolist() == [0, 0, 1, 1, 1, 1]
    assert below[0, 0, :, 60].tolist() == [0, 0, 0, 0, 1, 1]
    assert below[1].min() == 1  # no sample at all: nothing is masked
