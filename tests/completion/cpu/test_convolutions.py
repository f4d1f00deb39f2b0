"""The convolutions refuse maps and weights that do not fit each other, before they touch memory."""

from __future__ import annotations

import numpy as np
import pytest

from completion.cpu import convolutions
from completion.cpu.patches import COARSER, NOTHING, SAME, Added, Layer, Summands
from completion.cpu.row_threads import RowThreads

ROWS = RowThreads(1)


def zeros(*shape: int) -> np.ndarray:
    return np.zeros(shape, np.float32)


def layer(*shape: int, outputs: int = 4) -> Layer:
    return Layer(zeros(*shape), zeros(outputs))


@pytest.mark.parametrize(
    ("shapes", "weights", "added", "out", "message"),
    [
        ([(8, 12, 3)], layer(36, 5, 8), Added(zeros(8, 12, 4), NOTHING), zeros(8, 12, 4), "input: .* got .*8, 12, 3"),
        ([(8, 12, 5), (8, 11, 5)], layer(36, 5, 8), Added(zeros(8, 12, 4), SAME), zeros(8, 12, 4), "input"),
        ([(8, 12, 5)], layer(36, 5, 4), Added(zeros(8, 12, 4), SAME), zeros(8, 12, 4), "3x3 weights: .*any, 8"),
        ([(8, 12, 5)], layer(9, 5, 8), Added(zeros(8, 12, 4), SAME), zeros(8, 12, 4), "3x3 weights"),
        ([(8, 12, 5)], layer(36, 5, 8, outputs=3), Added(zeros(8, 12, 4), SAME), zeros(8, 12, 4), "3x3 bias"),
        ([(8, 12, 5)], layer(36, 5, 8), Added(zeros(4, 6, 4), SAME), zeros(8, 12, 4), "added map"),
        ([(8, 12, 5)], layer(36, 5, 8), Added(zeros(4, 6, 3), COARSER), zeros(8, 12, 4), "added map"),
        ([(8, 12, 5)], layer(36, 5, 8), Added(zeros(8, 12, 4), SAME), zeros(8, 24, 4)[:, ::2], "C-contiguous"),
    ],
)
def test_a_convolution_refuses(
    shapes: list[tuple[int, ...]], weights: Layer, added: Added, out: np.ndarray, message: str
) -> None:
    summands = Summands.of(tuple(zeros(*shape) for shape in shapes))
    with pytest.raises(ValueError, match=message):
        convolutions.convolve(ROWS, summands, weights, added, out)


def test_the_others_refuse() -> None:
    nothing = Added(zeros(8, 12, 4), NOTHING)
    with pytest.raises(ValueError, match="stem: expected weights of 9 x 2 inputs"):
        convolutions.convolve_stem(
            ROWS, zeros(2, 8, 12), layer(9, 8, outputs=5), layer(36, 5, 8), nothing, zeros(8, 12, 4)
        )
    with pytest.raises(ValueError, match=r"input: expected float32 of shape \(16, 24, 5\)"):
        convolutions.halve(ROWS, zeros(16, 22, 5), layer(9, 5, 8), zeros(8, 12, 4))
    with pytest.raises(ValueError, match=r"output: expected float32 of shape \(16, 24, any\)"):
        convolutions.double(ROWS, Summands.of((zeros(8, 12, 5),)), layer(9, 5, 8), zeros(16, 23, 4))
    with pytest.raises(ValueError, match=r"head weights: .*any, 32"):
        convolutions.convolve_head(ROWS, zeros(8, 12, 5), layer(5, 24, outputs=3), zeros(3, 8, 12))
    with pytest.raises(ValueError, match=r"input: expected float32 of shape \(16, 24, 5\)"):
        convolutions.quarter(ROWS, zeros(16, 24, 6), layer(2, 10, 8), zeros(8, 12, 4))
    with pytest.raises(ValueError, match="skip"):
        convolutions.lift(ROWS, zeros(8, 12, 5), layer(5, 8), zeros(16, 24, 5), zeros(16, 24, 4))
    with pytest.raises(ValueError, match="lifting: expected weights of 5 inputs"):
        convolutions.lift(ROWS, zeros(8, 12, 5), layer(6, 8), zeros(16, 24, 4), zeros(16, 24, 4))
