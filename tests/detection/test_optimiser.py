"""adam_onecycle and the momentum of batch normalisation, by hand."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from detection.optimiser import AdamOneCycle, OneCycleSettings, batchnorm_momentum, one_cycle


def test_schedule_at_its_corners_and_middles() -> None:
    settings = OneCycleSettings()
    steps = 1000
    expected = {
        0: (0.0002, 0.95),
        200: (0.0011, 0.90),  # half way up: (0.0002 + 0.002) / 2
        400: (0.002, 0.85),
        700: ((0.002 + 0.0002 / 1e4) / 2, 0.90),
    }
    for step, (rate, momentum) in expected.items():
        assert one_cycle(step, steps, 0.002, settings) == pytest.approx((rate, momentum))
    last = one_cycle(999, steps, 0.002, settings)
    assert last[0] == pytest.approx(0.0002 / 1e4 + 0.002 / 2 * (1 + math.cos(math.pi * 599 / 600)), rel=1e-3)
    assert one_cycle(0, 1, 0.002, settings)[0] > 0


def test_first_update_decays_everything_then_moves_by_the_rate() -> None:
    model = nn.Linear(1, 1)
    with torch.no_grad():
        model.weight.fill_(2.0)
        model.bias.fill_(-3.0)
    optimiser = AdamOneCycle(model, 100, 0.02, OneCycleSettings(decay=0.5, clip=100.0))
    (model.weight.sum() * 3 + model.bias.sum() * 0.0).backward()
    norm = optimiser.step(0)
    rate = 0.002
    # Adam's first step is the rate in the direction of the gradient; the bias has none and only decays.
    assert model.weight.item() == pytest.approx(2.0 * (1 - 0.5 * rate) - rate, rel=1e-6)
    assert model.bias.item() == pytest.approx(-3.0 * (1 - 0.5 * rate), rel=1e-6)
    assert norm == pytest.approx(3.0)


def test_gradient_is_clipped_by_its_norm() -> None:
    # With beta2's correction Adam's first step ignores size, so look at its memory: (1 - beta1) * clipped gradient.
    model = nn.Linear(1, 1, bias=False)
    optimiser = AdamOneCycle(model, 100, 0.002, OneCycleSettings(clip=1.0))
    (model.weight.sum() * 50).backward()
    optimiser.step(0)
    assert optimiser.state_tensors()["exp_avg.weight"].item() == pytest.approx(0.05, rel=1e-4)


def test_batchnorm_momentum_changes_at_the_first_epoch_after_1000_iterations() -> None:
    assert [batchnorm_momentum(step, 1200) for step in (0, 1199, 1200, 9000)] == [0.1, 0.1, 0.05, 0.05]
    assert [batchnorm_momentum(step, 600) for step in (600, 1199, 1200)] == [0.1, 0.1, 0.05]
