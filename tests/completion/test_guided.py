"""The guided network: its candidates against a walk along the column, its surfaces, and what it can never predict."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from completion.models.candidates import candidate_count, find_candidates
from completion.models.guided import Guided
from completion.twin_surface import split_head
from tests.completion.scenes import street
from tests.reference import completion_candidates as reference


def sparse_map(rng: np.random.Generator, height: int = 24, width: int = 30) -> np.ndarray:
    sparse = rng.uniform(2, 60, (height, width)) * (rng.random((height, width)) < 0.08)
    sparse[:, 12:18] = 0  # columns without any sample
    return sparse.astype(np.float32)


def test_candidates_agree_with_a_walk(rng: np.random.Generator) -> None:
    sparse = sparse_map(rng)
    found = find_candidates(torch.from_numpy(sparse)[None, None])
    assert found.count == candidate_count()
    for row in range(sparse.shape[0]):
        for column in range(sparse.shape[1]):
            for k, expected in enumerate(reference.up_and_down(sparse, row, column)):
                prior, log_depth = float(found.prior[0, k, row, column]), float(found.log_depth[0, k, row, column])
                if expected is None:
                    assert prior == -30
                else:
                    assert (log_depth, prior) == pytest.approx(expected, abs=1e-5)


def test_shifted_candidates_are_those_of_other_columns(rng: np.random.Generator) -> None:
    found = find_candidates(torch.from_numpy(sparse_map(rng))[None, None])
    assert torch.equal(found.log_depth[0, 2, :, 4:], found.log_depth[0, 0, :, :-4])  # shift -4, up
    assert (found.prior[0, 2, :, :4] == -30).all()


def test_second_ring_lies_behind_the_first() -> None:
    sparse = torch.zeros(1, 1, 20, 3)
    sparse[0, 0, [4, 10, 16], 1] = torch.tensor([30.0, 20.0, 10.0])
    found = find_candidates(sparse)
    at = found.log_depth[0, :, 12, 1].exp()
    assert [float(at[k]) for k in (0, 1, -2)] == pytest.approx([20, 10, 30])
    assert float(found.prior[0, -1, 12, 1]) == -30  # nothing below the first below


def untrained(**arguments: float) -> Guided:
    """The network with a silent head: candidates and prior alone decide."""
    model = Guided(width=8, **arguments)
    torch.nn.init.zeros_(model.network.head.weight)
    torch.nn.init.zeros_(model.network.head.bias)
    return model.eval()


def test_untrained_it_interpolates_a_plane_in_inverse_depth() -> None:
    inverse = torch.linspace(0.02, 0.1, 64).view(1, 1, 64, 1).expand(1, 1, 64, 64)
    sparse = torch.zeros(1, 1, 64, 64)
    sparse[..., ::8, :] = 1 / inverse[..., ::8, :]
    with torch.inference_mode():
        (out,) = untrained(tilt=1e-3, cut=0.0)(sparse, torch.zeros(1, 3, 64, 64))
    middle = (out[0, 0] * inverse[0, 0])[8:48]
    assert float((middle - 1).abs().max()) < 0.05


def test_surfaces_are_ordered_and_of_one_of_two_objects() -> None:
    """Rings on a car at 10 m and a wall at 40 m: no surface lies between the two, which plain interpolation does."""
    sparse = torch.zeros(1, 1, 64, 64)
    sparse[..., 10, :] = 40.0
    sparse[..., 40, :] = 10.0
    with torch.inference_mode():
        (out,) = untrained(tilt=6.0)(sparse, torch.zeros(1, 3, 64, 64))
    foreground, background, sigma = split_head(out, 1.0)
    assert bool((foreground <= background).all())
    between = slice(14, 37)
    assert foreground[0, between].flatten().tolist() == pytest.approx([10.0] * 23 * 64, rel=5e-3)
    assert background[0, between].flatten().tolist() == pytest.approx([40.0] * 23 * 64, rel=5e-3)
    assert sigma[0, 0, 0] == 0.5


def test_depths_stay_within_the_candidates(rng: np.random.Generator) -> None:
    """Whatever the weights: between the nearest and farthest candidate, the image's own one included, +- residual."""
    torch.manual_seed(1)
    model = Guided(width=8, residual=0.03).eval()
    torch.nn.init.normal_(model.network.head.weight, std=1.0)
    frame = street(3, 64, 128)
    sparse = torch.from_numpy(frame.sparse)[None, None]
    rgb = torch.from_numpy(frame.image).permute(2, 0, 1)[None].float() / 255
    with torch.inference_mode():
        (out,) = model(sparse, rgb)
    foreground, background, _ = split_head(out, 1.0)
    largest, least = max(float(sparse.max()), 10 * math.exp(2.6)), min(2.0, 10 * math.exp(-2.0))
    assert float(background.max()) <= largest * 1.031
    assert float(foreground.min()) >= least * 0.969


def test_gradients_reach_every_parameter() -> None:
    frame = street(5, 64, 128)
    model = Guided(width=8)
    rgb = torch.from_numpy(frame.image).permute(2, 0, 1)[None].float() / 255
    (out,) = model(torch.from_numpy(frame.sparse)[None, None], rgb)
    out.square().mean().backward()
    silent = [name for name, p in model.named_parameters() if p.grad is None or float(p.grad.abs().max()) == 0]
    assert silent == []


def test_a_cut_that_could_leave_no_candidate_is_refused() -> None:
    with pytest.raises(ValueError, match="cut"):
        Guided(cut=1.0)


@pytest.mark.parametrize("cut", [0.02, 0.0])
def test_fused_inference_agrees_with_torch(rng: np.random.Generator, cut: float) -> None:
    torch.manual_seed(2)
    model = Guided(width=8, cut=cut).eval()
    torch.nn.init.normal_(model.network.head.weight, std=0.5)
    sparse = torch.from_numpy(np.stack([sparse_map(rng, 64, 128), 0 * sparse_map(rng, 64, 128)]))[:, None]
    rgb = torch.rand(2, 3, 64, 128)
    with torch.no_grad():
        (expected,) = model(sparse, rgb)
    with torch.inference_mode():
        (found,) = model(sparse, rgb)
    torch.testing.assert_close(found, expected, rtol=2e-4, atol=2e-4)
