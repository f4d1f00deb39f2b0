"""The product kernel against numpy: every number of rows and columns it has blocks for, views, and its borders."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from completion.cpu.small_gemm import LANES, multiply, with_whole_lanes


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 20), st.integers(1, 30), st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_product_is_numpys_and_keeps_to_its_place(rows: int, inputs: int, lanes: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((2 * rows + 1, inputs)).astype(np.float32)[1::2]  # every other row of a larger map
    b = rng.standard_normal((inputs, lanes * LANES)).astype(np.float32)
    around = np.full((rows + 2, lanes * LANES + 4), np.nan, np.float32)
    inside = around[1:-1, 2:-2]
    multiply(a, b, inside)
    np.testing.assert_allclose(inside, a.astype(np.float64) @ b, atol=1e-4)
    inside[:] = np.nan
    assert np.isnan(around).all()


@pytest.mark.parametrize(("outputs", "whole"), [(8, 8), (9, 16), (27, 32)])
def test_lanes_are_filled_with_zeros(outputs: int, whole: int) -> None:
    weights = np.arange(2 * 3 * outputs, dtype=np.float32).reshape(2, 3, outputs) + 1
    padded = with_whole_lanes(weights)
    assert padded.shape == (2, 3, whole)
    assert padded.flags.c_contiguous
    assert (padded[..., :outputs] == weights).all()
    assert not padded[..., outputs:].any()
