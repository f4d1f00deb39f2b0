"""Sampling, grouping and interpolation against plain loops: indices must be equal, not close."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from detection.ops import (
    _torch_points,
    ball_query,
    furthest_point_sample,
    group_points,
    interpolation_weights,
    three_interpolate,
    three_nn,
)
from tests.reference import ops_points as twin

KINDS = ("scattered", "lattice with duplicates", "one place", "line", "far from the origin")


def cloud(kind: str, count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = {
        "scattered": rng.normal(size=(count, 3)) * [20, 1, 30],
        "lattice with duplicates": rng.integers(0, 5, (count, 3)) * 0.5,
        "one place": np.full((count, 3), 2.5),
        "line": rng.uniform(0, 50, (count, 1)) * [1, 0, 0],
        "far from the origin": rng.normal([500, -3, 900], 1, (count, 3)),
    }[kind]
    return points.astype(np.float32)


kinds = st.sampled_from(KINDS)
seeds = st.integers(0, 2**32 - 1)


@given(kinds, st.integers(1, 700), st.integers(1, 120), seeds)
@settings(max_examples=40, deadline=None)
def test_furthest_points_are_those_of_the_plain_loop(kind: str, count: int, npoint: int, seed: int) -> None:
    points = cloud(kind, count, seed)
    expected = twin.furthest_point_sample(points, npoint)
    assert furthest_point_sample(torch.from_numpy(points), npoint).tolist() == expected
    assert _torch_points.furthest_point_sample(torch.from_numpy(points)[None], npoint)[0].tolist() == expected


@pytest.mark.parametrize("kind", KINDS)
def test_furthest_points_of_a_large_cloud(kind: str) -> None:
    points = cloud(kind, 20_000)
    assert furthest_point_sample(torch.from_numpy(points), 600).tolist() == twin.furthest_point_sample(points, 600)


def test_furthest_points_by_hand() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [4, 0, 0], [4, 0, 0], [-4, 0, 0]])
    # 2, 3 and 4 are equally far from 0: the lowest index first; then everything is taken and 0 repeats.
    assert furthest_point_sample(points, 7).tolist() == [0, 2, 4, 1, 0, 0, 0]


@given(kinds, st.integers(1, 400), st.sampled_from([0.1, 0.5, 1.0, 8.0]), st.integers(1, 40), seeds)
@settings(max_examples=40, deadline=None)
def test_ball_query_is_that_of_the_plain_loop(kind: str, count: int, radius: float, nsample: int, seed: int) -> None:
    points = cloud(kind, count, seed)
    centres = np.concatenate([points[:20], points[:1] + 1000, cloud(kind, 9, seed + 1)]).astype(np.float32)
    expected = twin.ball_query(points, centres, radius, nsample)
    source, around = torch.from_numpy(points), torch.from_numpy(centres)
    assert ball_query(source, around, radius, nsample).tolist() == expected
    radius2 = float(np.float32(radius) * np.float32(radius))
    assert _torch_points.ball_query(source[None], around[None], radius2, nsample)[0].tolist() == expected


def test_ball_query_by_hand() -> None:
    points = torch.tensor([[9.0, 0, 0], [1, 0, 0], [0.5, 0, 0], [0, 0, 0], [0.25, 0, 0]])
    centres = torch.tensor([[0.0, 0, 0], [100, 0, 0]])
    # At exactly 1 m is outside; the first hit, not the nearest, fills; an empty ball points at 0.
    assert ball_query(points, centres, 1.0, 5).tolist() == [[2, 3, 4, 2, 2], [0, 0, 0, 0, 0]]
    assert ball_query(points, centres, 1.0, 2).tolist() == [[2, 3], [0, 0]]


@given(kinds, st.integers(1, 300), st.integers(1, 60), seeds)
@settings(max_examples=40, deadline=None)
def test_three_nearest_are_those_of_the_plain_loop(kind: str, count: int, queries: int, seed: int) -> None:
    known, unknown = cloud(kind, count, seed), cloud(kind, queries, seed + 1)
    unknown[: min(count, queries) // 2] = known[: min(count, queries) // 2]
    distances, indices = twin.three_nn(unknown, known)
    distance, index = three_nn(torch.from_numpy(unknown), torch.from_numpy(known))
    assert index.tolist() == indices
    # torch's vectorised float32 root is off by one unit in the last place here and there.
    assert np.allclose(distance.numpy(), distances, rtol=1.2e-7, atol=0)
    squared, index = _torch_points.three_nn(torch.from_numpy(unknown)[None], torch.from_numpy(known)[None])
    assert index[0].tolist() == indices
    assert np.sqrt(squared[0].numpy()).tolist() == distances


def test_three_nearest_of_fewer_than_three() -> None:
    distance, index = three_nn(torch.tensor([[0.0, 0, 0]]), torch.tensor([[3.0, 0, 4], [1, 0, 0]]))
    assert distance.tolist() == [[1.0, 5.0, float("inf")]]
    assert index.tolist() == [[1, 0, 0]]
    weight = interpolation_weights(distance)
    assert torch.allclose(weight, torch.tensor([[5 / 6, 1 / 6, 0.0]]))


def test_weights_use_the_distance_and_a_coinciding_point_takes_all() -> None:
    weight = interpolation_weights(torch.tensor([[0.0, 1.0, 2.0], [1.0, 2.0, 4.0]]))
    assert weight[0].tolist() == pytest.approx([1.0, 1e-8, 5e-9], rel=1e-4)
    assert weight[1].tolist() == pytest.approx([4 / 7, 2 / 7, 1 / 7], rel=1e-6)


def test_interpolation_and_its_gradients() -> None:
    rng = np.random.default_rng(3)
    features, weight = rng.normal(size=(5, 9)), rng.uniform(size=(7, 3))
    index = rng.integers(0, 9, (7, 3))
    index[0] = 4  # one point three times
    result = three_interpolate(torch.from_numpy(features), torch.from_numpy(index), torch.from_numpy(weight))
    assert np.allclose(result.numpy(), twin.three_interpolate(features, index, weight), rtol=0, atol=1e-14)

    batch = torch.from_numpy(np.stack([features, -2 * features])).requires_grad_()
    indices = torch.from_numpy(np.stack([index, index[::-1].copy()]))
    weights = torch.from_numpy(np.stack([weight, weight + 1])).requires_grad_()
    assert torch.autograd.gradcheck(lambda f, w: three_interpolate(f, indices, w), (batch, weights))


def test_interpolation_is_exact_where_points_coincide() -> None:
    known = torch.from_numpy(cloud("scattered", 50))
    features = torch.randn(1, 8, 50, generator=torch.Generator().manual_seed(0))
    distance, index = three_nn(known[None], known[None])
    assert torch.allclose(three_interpolate(features, index, interpolation_weights(distance)), features, atol=1e-5)


def test_grouping_and_its_gradient() -> None:
    rng = np.random.default_rng(4)
    features, index = rng.normal(size=(2, 3, 11)), rng.integers(0, 11, (2, 4, 5))
    index[0, 0] = 7
    grouped = group_points(torch.from_numpy(features), torch.from_numpy(index))
    expected = np.stack([features[b][:, index[b]] for b in range(2)])
    assert np.array_equal(grouped.numpy(), expected)
    sampled = group_points(torch.from_numpy(features[0]), torch.from_numpy(index[0, 0]))
    assert np.array_equal(sampled.numpy(), features[0][:, index[0, 0]])

    cotangent = rng.normal(size=expected.shape)
    source = torch.from_numpy(features).requires_grad_()
    group_points(source, torch.from_numpy(index)).backward(torch.from_numpy(cotangent))
    gradient = np.zeros_like(features)
    for b, p, s in np.ndindex(*index.shape):
        gradient[b, :, index[b, p, s]] += cotangent[b, :, p, s]
    assert source.grad is not None
    assert np.allclose(source.grad.numpy(), gradient, rtol=0, atol=1e-14)
    assert torch.autograd.gradcheck(lambda f: group_points(f, torch.from_numpy(index)), source)


@pytest.mark.parametrize("batch", [1, 2, 3])
def test_batches_and_threads_do_not_change_results(batch: int) -> None:
    points = torch.from_numpy(np.stack([cloud("scattered", 5000, seed) for seed in range(batch)]))
    known = points[:, :3000].contiguous()
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 4):
            torch.set_num_threads(threads)
            distance, nearest = three_nn(points, known)
            balls = ball_query(points, known, 3.0, 16)
            results.append((furthest_point_sample(points, 100), balls, distance, nearest))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
    for b in range(batch):
        assert torch.equal(results[0][0][b], furthest_point_sample(points[b], 100))
        assert torch.equal(results[0][1][b], ball_query(points[b], known[b], 3.0, 16))
        assert torch.equal(results[0][3][b], three_nn(points[b], known[b])[1])


def test_the_torch_search_is_the_same_in_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    points = torch.from_numpy(cloud("lattice with duplicates", 300))[None]
    whole = _torch_points.ball_query(points, points, 0.3, 8), _torch_points.three_nn(points, points)
    monkeypatch.setattr(_torch_points, "_PAIRS", 1000)
    assert torch.equal(_torch_points.ball_query(points, points, 0.3, 8), whole[0])
    assert torch.equal(_torch_points.three_nn(points, points)[1], whole[1][1])


def test_wrong_input_is_named() -> None:
    points = torch.zeros(4, 3)
    with pytest.raises(ValueError, match=r"xyz: expected \(B, N, 3\) or \(N, 3\), got shape \(4, 2\)"):
        furthest_point_sample(torch.zeros(4, 2), 1)
    with pytest.raises(ValueError, match="at least one point"):
        furthest_point_sample(torch.zeros(0, 3), 1)
    with pytest.raises(ValueError, match="npoint: expected a whole number of at least 1, got 0"):
        furthest_point_sample(points, 0)
    with pytest.raises(ValueError, match="xyz: 1 points hold NaN"):
        furthest_point_sample(torch.tensor([[0.0, 0, float("nan")]]), 1)
    with pytest.raises(ValueError, match="radius: expected a positive number"):
        ball_query(points, points, 0.0, 3)
    with pytest.raises(ValueError, match="equal batch sizes, got 2 and 1"):
        ball_query(points[None].expand(2, 4, 3), points[None], 1.0, 3)
    with pytest.raises(ValueError, match="known: expected at least one point"):
        three_nn(points, torch.zeros(0, 3))
    with pytest.raises(ValueError, match="index and weight: expected equal shapes"):
        three_interpolate(torch.zeros(1, 4), torch.zeros(2, 3, dtype=torch.int64), torch.zeros(3, 3))
    with pytest.raises(TypeError, match="floating point"):
        furthest_point_sample(torch.zeros(4, 3, dtype=torch.int64), 1)
