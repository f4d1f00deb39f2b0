"""Depth Coefficients: exact round trips, hand-made numbers, and the loop versions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from completion.depth_coefficients import (
    INDOOR,
    OUTDOOR,
    Bins,
    cross_entropy,
    decode,
    decode_logits,
    encode,
)
from tests.reference import completion_coefficients as reference

LAYOUTS = [OUTDOOR, INDOOR, Bins(80, 1.0, "compact"), Bins(10, 0.5)]


def test_published_sizes() -> None:
    assert OUTDOOR.channels == 82
    assert Bins(80, 1.0, "compact").channels == 80
    assert INDOOR.range == 10.0


def test_coefficients_by_hand() -> None:
    """10.2 m: delta 0.2, so (0.15, 0.5, 0.35) on bins 9, 10, 11: beyond the centre weighs on the deeper bin."""
    code = encode(np.array(10.2))
    assert code[9:12] == pytest.approx([0.15, 0.5, 0.35])
    assert code.sum() == pytest.approx(1)
    assert np.count_nonzero(code) == 3


@pytest.mark.parametrize("bins", LAYOUTS)
@pytest.mark.parametrize("which", ["all", "peak"])
def test_round_trip_is_exact(bins: Bins, which: str, rng: np.random.Generator) -> None:
    lowest = 0.5 * bins.size if bins.layout == "guard" else bins.size
    depth = rng.uniform(lowest * (1 + 1e-9), bins.range, 2000)
    code = encode(depth, bins)
    assert np.abs(decode(code, bins, which) - depth).max() < 1e-12 * max(1, bins.range)
    assert np.abs(code.sum(-1) - 1).max() < 1e-14
    assert code.min() >= 0


@given(st.floats(0.5, 90))
def test_encode_agrees_with_the_loop(depth: float) -> None:
    assert encode(np.array(depth)) == pytest.approx(reference.encode_one(depth), abs=1e-12)


def test_what_cannot_be_encoded() -> None:
    depth = np.array([0.0, 0.4, 0.5, 85.0])
    assert decode(encode(depth)).tolist() == [0, 0, 0, 80]
    assert decode(encode(np.array([80.3, 80.5, 80.6]), beyond="drop")).tolist() == pytest.approx([80.3, 80.5, 0])


def test_half_way_needs_two_bins() -> None:
    assert encode(np.array([10.5, 11.5]))[0, [10, 11]].tolist() == [0.5, 0.5]
    assert np.count_nonzero(encode(np.array([10.5, 11.5]))) == 4


def test_two_modes_decode_to_one_or_between() -> None:
    code = 0.6 * encode(np.array(10.0)) + 0.4 * encode(np.array(30.0))
    assert decode(code, which="peak") == pytest.approx(10.0)
    assert decode(code, which="all") == pytest.approx(18.0)


def test_peak_agrees_with_the_loop_and_takes_the_first_maximum(rng: np.random.Generator) -> None:
    codes = rng.random((50, 82))
    assert decode(codes, which="peak").tolist() == pytest.approx([reference.decode_peak(c) for c in codes])
    tie = np.zeros(82)
    tie[[20, 60]] = 0.5
    assert decode(tie, which="peak") == pytest.approx(20.0)


@pytest.mark.parametrize("peak", [0, 81])
def test_peak_in_a_guard_bin(peak: int) -> None:
    code = np.zeros(82)
    code[peak] = 1.0
    assert decode(code, which="peak", strict_reference=True) == 0
    assert decode(code, which="peak") == pytest.approx(float(peak))


def test_gaussian_weights_are_biased_but_little(rng: np.random.Generator) -> None:
    depth = rng.uniform(1, 79, 1000)
    error = np.abs(decode(encode(depth, method="gaussian")) - depth)
    assert 0.02 < error.max() < 0.05


def test_no_mass_between_two_planes() -> None:
    """Averaging coefficients of two planes 5 bins apart (thesis Fig. 3.3) leaves the bins between them empty."""
    planes = np.where(np.arange(30) < 15, 10.0, 15.0)
    code = encode(planes)
    smoothed = np.stack([np.convolve(code[:, j], np.ones(5) / 5, "same") for j in range(code.shape[1])], 1)
    assert smoothed[:, [12, 13]].max() == 0
    blurred_depth = np.convolve(planes, np.ones(5) / 5, "same")[3:-3]
    assert ((blurred_depth > 11.5) & (blurred_depth < 13.5)).any()
    peaks = decode(smoothed[3:-3], which="peak")
    assert np.minimum(np.abs(peaks - 10), np.abs(peaks - 15)).max() < 1e-9


def test_cross_entropy_agrees_with_the_dense_loop(rng: np.random.Generator) -> None:
    logits = rng.normal(size=(82, 4, 5))
    target = rng.uniform(0.2, 90, (4, 5)) * (rng.random((4, 5)) < 0.7)
    tensor = torch.from_numpy(target)[None, None]
    found = cross_entropy(torch.from_numpy(logits)[None], tensor, (tensor > 0).double())
    assert float(found) == pytest.approx(reference.cross_entropy_dense(logits, target), rel=1e-12)


@pytest.mark.parametrize(("depth", "entropy"), [(10.0, 1.0397), (10.5, 0.6931)])
def test_floor_of_the_loss_is_the_targets_entropy(depth: float, entropy: float) -> None:
    target = torch.full((1, 1, 1, 1), depth, dtype=torch.float64)
    code = encode(target[0, 0, 0, 0])
    logits = torch.log(code.clamp(min=1e-30)).view(1, 82, 1, 1).requires_grad_()
    loss = cross_entropy(logits, target, torch.ones_like(target))
    assert float(loss.detach()) == pytest.approx(entropy, abs=1e-4)
    loss.backward()
    assert logits.grad is not None
    assert float(logits.grad.abs().max()) < 1e-12  # the least value: p = c


def test_gradient_of_the_cross_entropy(rng: np.random.Generator) -> None:
    bins = Bins(6, 1.0)
    logits = torch.from_numpy(rng.normal(size=(2, 8, 2, 3))).requires_grad_()
    target = torch.from_numpy(rng.uniform(0.6, 6, (2, 1, 2, 3)))
    assert torch.autograd.gradcheck(lambda x: cross_entropy(x, target, torch.ones_like(target), bins), (logits,))


def test_logits_decode_to_metres() -> None:
    code = encode(torch.tensor([[[12.3, 40.0]]], dtype=torch.float64))
    logits = torch.log(code.clamp(min=1e-30)).permute(0, 3, 1, 2)
    assert decode_logits(logits)[0, 0].tolist() == pytest.approx([12.3, 40.0])


def test_wrong_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="layout"):
        Bins(80, 1.0, "open")
    with pytest.raises(ValueError, match="82 coefficients"):
        decode(np.zeros((3, 80)))
    with pytest.raises(ValueError, match="which"):
        decode(np.zeros(82), which="3")
    with pytest.raises(ValueError, match="method"):
        encode(np.zeros(2), method="cubic")
