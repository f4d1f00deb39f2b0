"""The mixture: its likelihood by hand, its quantiles as minimisers of the asymmetric losses, its read-outs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from completion.decoding import MIXTURE_DECODINGS, decode_output
from completion.losses import ale, rale
from completion.mixture import expected_depth, negative_log_likelihood, quantiles, twin_surfaces
from completion.models import default_spec


def mixture(weights: list[float], depths: list[float], raw_scale: float = 4.0) -> Tensor:
    """One pixel (1, 2 K + 1, 1, 1); raw scale 4 is 0.01 + 0.5 / 2 = 0.26 of the depth."""
    values = [math.log(w) if w else -100.0 for w in weights] + [math.log(z) for z in depths] + [raw_scale]
    return torch.tensor(values, dtype=torch.float64).view(1, -1, 1, 1)


def pixel(depth: float) -> Tensor:
    return torch.full((1, 1, 1, 1), depth, dtype=torch.float64)


def test_likelihood_by_hand() -> None:
    """One part, hit exactly: -ln 1 / (2 * 0.26). One part, off by a factor e: 1 / 0.26 more."""
    assert float(negative_log_likelihood(mixture([1], [10]), pixel(10))) == pytest.approx(math.log(0.52))
    off = negative_log_likelihood(mixture([1], [10]), pixel(10 * math.e))
    assert float(off) == pytest.approx(math.log(0.52) + 1 / 0.26)
    # Two parts: 0.25 / 0.52 e^0 + 0.75 / 0.52 e^(-ln 4 / 0.26)
    both = 0.25 / 0.52 + 0.75 / 0.52 * math.exp(-math.log(4) / 0.26)
    assert float(negative_log_likelihood(mixture([0.25, 0.75], [10, 40]), pixel(10))) == pytest.approx(-math.log(both))


def test_likelihood_integrates_to_one() -> None:
    logs = torch.linspace(-8, 14, 20001, dtype=torch.float64)
    one = mixture([0.3, 0.7], [5, 50]).expand(1, -1, 1, len(logs))
    density = torch.exp(-negative_log_likelihood(one, torch.exp(logs).view(1, 1, 1, -1)))[0, 0, 0]
    assert float(torch.trapezoid(density[logs > math.log(0.1)], logs[logs > math.log(0.1)])) == pytest.approx(1, 1e-3)


@pytest.mark.parametrize("gamma", [1.0, 1.5, 2.0, 4.0])
def test_quantiles_minimise_the_expected_asymmetric_losses(rng: np.random.Generator, gamma: float) -> None:
    for _ in range(20):
        weights, depths = rng.dirichlet(np.ones(10)), rng.uniform(3, 60, 10)
        foreground, background, _, median = (
            float(part) for part in twin_surfaces(mixture(weights.tolist(), depths.tolist()), gamma)
        )
        errors = torch.from_numpy(depths[:, None] - depths[None])  # every candidate as estimate, each as truth
        shares = torch.from_numpy(weights)
        near, far = ((loss(errors, gamma) * shares).sum(1) for loss in (ale, rale))
        assert foreground == pytest.approx(depths[int(near.argmin())])
        assert background == pytest.approx(depths[int(far.argmin())])
        assert median == pytest.approx(depths[int((errors.abs() * shares).sum(1).argmin())])
        assert foreground <= median <= background


def test_two_modes_give_both_surfaces_and_sigma() -> None:
    """Foreground with 30 %: gamma > sqrt(p2 / p1) (Eq. 4.6) holds for gamma = 2, and not for gamma = 1.2."""
    bimodal = mixture([0.3, 0.7], [10, 40])
    found = [float(part) for part in twin_surfaces(bimodal, 2.0)]
    assert found == pytest.approx([10, 40, 0.3, 40])
    found = [float(part) for part in twin_surfaces(bimodal, 1.2)]
    assert found == pytest.approx([40, 40, 1, 40])


def test_sigma_divides_at_the_geometric_mean() -> None:
    """Between 10 m and 40 m the border is at 20 m: 19 m counts as near, 21 m as far."""
    found = twin_surfaces(mixture([0.3, 0.15, 0.15, 0.4], [10, 19, 21, 40]))
    assert [float(part) for part in found[:3]] == pytest.approx([10, 40, 0.45])


def test_equal_surfaces_count_their_own_candidate() -> None:
    """In float32, where exp(ln z) need not be z."""
    near = torch.linspace(2, 80, 1000).view(1, 1, 1, -1)
    logits = torch.stack((torch.full_like(near, 9.0), torch.full_like(near, -9.0)), 1)[:, :, 0]
    sure = torch.cat((logits, near.log(), (2 * near).log(), torch.zeros_like(near)), 1)
    assert float(twin_surfaces(sure)[2].min()) > 0.99


def test_decodings_by_hand() -> None:
    bimodal = mixture([0.4, 0.6], [10, 40])
    expected = {"median": 40, "expected": 28, "fused": 28, "foreground": 10, "background": 40, "mean": 25, "hard": 40}
    assert set(expected) == set(MIXTURE_DECODINGS)
    for name, value in expected.items():
        depth, foreground, background, sigma = decode_output(bimodal, default_spec("selection"), name)
        assert float(depth) == pytest.approx(value, rel=1e-5), name
        assert foreground is not None
        assert background is not None
        assert sigma is not None
        assert [float(foreground), float(background), float(sigma)] == pytest.approx([10, 40, 0.4], rel=1e-5)
    assert float(expected_depth(bimodal)) == pytest.approx(28)


def test_the_median_never_lies_between_two_modes(rng: np.random.Generator) -> None:
    near, far = rng.uniform(8, 12, (200, 5)), rng.uniform(35, 45, (200, 5))
    weights = rng.dirichlet(np.ones(10), 200)
    values = np.concatenate((np.log(weights), np.log(np.concatenate((near, far), 1)), np.zeros((200, 1))), 1)
    many = torch.from_numpy(values).view(200, 21, 1, 1)
    median, mean = quantiles(many, (0.5,))[0], expected_depth(many)
    assert not bool(((median > 12.001) & (median < 34.999)).any())
    assert bool(((mean > 13) & (mean < 34)).any())  # which the mean does
