"""Samplers: the rule of the papers, any size of cloud, the same draw for the same seed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from detection.sampling import balanced_sample, near_far_sample, uniform_sample

Sampler = Callable[[NDArray[np.float32], int, np.random.Generator], NDArray[np.int64]]


def balanced(points: NDArray[np.float32], count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    return balanced_sample(points, np.ones(len(points)), count, rng)


SAMPLERS: list[Sampler] = [near_far_sample, uniform_sample, balanced]


def cloud(near: int, far: int) -> NDArray[np.float32]:
    z = np.concatenate([np.linspace(1, 39.9, near), np.linspace(40, 70, far)])
    return np.column_stack([np.zeros(near + far), np.zeros(near + far), z]).astype(np.float32)


def test_all_far_points_are_kept(rng) -> None:
    index = near_far_sample(cloud(500, 60), 100, rng)
    assert sorted(i for i in index if i >= 500) == list(range(500, 560))
    assert len(set(index.tolist())) == 100
    assert (np.diff(index) < 0).any()  # shuffled


def test_more_far_points_than_asked_for(rng) -> None:
    index = near_far_sample(cloud(50, 200), 100, rng)
    assert len(set(index.tolist())) == 100
    assert (index < 50).any()


@pytest.mark.parametrize("sampler", SAMPLERS)
@settings(max_examples=30, deadline=None)
@given(near=st.integers(0, 60), far=st.integers(0, 60), count=st.integers(1, 80), seed=st.integers(0, 5))
def test_any_size_gives_count_valid_indices(sampler, near, far, count, seed) -> None:
    if near + far == 0:
        with pytest.raises(ValueError, match="empty cloud"):
            sampler(cloud(0, 0), count, np.random.default_rng(seed))
        return
    points = cloud(near, far)
    index = sampler(points, count, np.random.default_rng(seed))
    assert index.shape == (count,)
    assert set(index.tolist()) <= set(range(len(points)))
    assert len(set(index.tolist())) == min(count, len(points))
    assert (index == sampler(points, count, np.random.default_rng(seed))).all()


def test_few_duplicates_are_drawn_without_replacement(rng) -> None:
    counts = np.bincount(near_far_sample(cloud(40, 20), 100, rng))
    assert sorted(set(counts.tolist())) == [1, 2]


def test_balanced_prefers_distant_and_standing_points(rng) -> None:
    points = np.zeros((3000, 3), dtype=np.float32)
    points[:, 2] = np.repeat([6.0, 30.0, 30.0], 1000)
    height = np.repeat([1.0, 1.0, 0.0], 1000)
    share = np.bincount(balanced_sample(points, height, 600, rng) // 1000, minlength=3) / 600
    # Weights 0.2, 1 and 0.3.
    assert share[1] > 0.55
    assert share[2] > share[0] > 0.05
