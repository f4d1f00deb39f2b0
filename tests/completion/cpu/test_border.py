"""A kernel refuses maps of another shape or type than it takes, before it touches memory."""

from __future__ import annotations

import numpy as np
import pytest

from completion.cpu.border import require
from completion.cpu.pixel_unet import Head
from completion.cpu.ring_coefficients import RingLogits, read_coefficients
from completion.cpu.selection import Candidates, read_mixture, read_mixture_of_features
from completion.models.selection import CANDIDATES, CHANNELS


def zeros(*shape: int) -> np.ndarray:
    return np.zeros(shape, np.float32)


CANDIDATE_MAPS = Candidates(zeros(3, 32, 64), 2, np.array([0, -6, 6]), np.float32(0.1), zeros(3))
HEAD = Head(zeros(2, 8, 4 * CANDIDATES), zeros(2, 4 * CANDIDATES))
RINGS = RingLogits(zeros(5, 32, 64), 2, np.float32(1), 10)
RING_HEAD = Head(zeros(2, 8, 24), zeros(2, 24))


@pytest.mark.parametrize(
    ("head", "candidates", "out", "message"),
    [
        (zeros(16, 31, 84), CANDIDATE_MAPS, zeros(4, 30, 60), r"head: expected float32 of shape \(16, 32, 84\)"),
        (zeros(16, 32, 84).astype(float), CANDIDATE_MAPS, zeros(4, 30, 60), "head: .* got float64"),
        (zeros(16, 32, 84), CANDIDATE_MAPS, zeros(4, 31, 60), "31 x 60 from row 2 on exceed the logs' 32 x 64"),
        (zeros(16, 32, 84), CANDIDATE_MAPS, zeros(3, 30, 60), r"maps: expected float32 of shape \(4, any, any\)"),
        (zeros(16, 32, 84), CANDIDATE_MAPS._replace(shifts=np.zeros(4, int)), zeros(4, 30, 60), "shifts: expected 3"),
        (zeros(16, 32, 84), CANDIDATE_MAPS._replace(shares=zeros(2)), zeros(4, 30, 60), "shares"),
    ],
)
def test_the_fused_pass_refuses_other_maps(
    head: np.ndarray, candidates: Candidates, out: np.ndarray, message: str
) -> None:
    assert head.shape[2] == 4 * CHANNELS
    with pytest.raises(ValueError, match=message):
        read_mixture(head, candidates, False, out)


@pytest.mark.parametrize(
    ("features", "head", "message"),
    [
        (zeros(16, 31, 8), HEAD, "features"),
        (zeros(16, 32, 9), HEAD, "head weights"),
        (zeros(16, 32, 8), HEAD._replace(bias=zeros(2, 39)), "head biases"),
    ],
)
def test_the_fused_last_layer_refuses_other_maps(features: np.ndarray, head: Head, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_mixture_of_features(features, head, CANDIDATE_MAPS, False, zeros(4, 30, 60))


@pytest.mark.parametrize(
    ("features", "head", "added", "out", "message"),
    [
        (zeros(16, 31, 8), RING_HEAD, RINGS, zeros(30, 60), "features"),
        (zeros(16, 32, 8), RING_HEAD, RINGS._replace(channels=13), zeros(30, 60), "do not hold 13 bins"),
        (zeros(16, 32, 8), RING_HEAD, RINGS, zeros(30, 65), "a depth map 30 x 65 from row 2"),
        (zeros(16, 32, 8), RING_HEAD, RINGS._replace(rings=zeros(4, 32, 64)), zeros(30, 60), "rings"),
        (zeros(16, 32, 8), Head(zeros(1, 8, 24), zeros(2, 24)), RINGS, zeros(30, 60), "head weights"),
    ],
)
def test_coefficients_refuse_other_maps(
    features: np.ndarray, head: Head, added: RingLogits, out: np.ndarray, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        read_coefficients(features, head, added, True, out)


def test_an_axis_of_any_length_is_not_empty() -> None:
    assert require("map", zeros(2, 5), (2, None)) == (2, 5)
    with pytest.raises(ValueError, match=r"map: expected float32 of shape \(2, any\), got float32 of shape \(2, 0\)"):
        require("map", zeros(2, 0), (2, None))
