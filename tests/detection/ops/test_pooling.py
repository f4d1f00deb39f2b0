"""RoI pooling and points in boxes against plain loops."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from detection.ops import _torch_points, points_in_boxes, roi_pool
from detection.ops._pooling_torch import _turned, enlarged
from tests.reference import ops_points as twin


def scene(seed: int, count: int, rois: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points round a few boxes, features that name the point, and boxes of which the last is far from everything."""
    rng = np.random.default_rng(seed)
    cloud = rng.uniform([-6, -1, 20], [6, 2, 32], (count, 3)).astype(np.float32)
    features = np.column_stack([np.arange(count), rng.normal(size=count)]).astype(np.float32)
    centre = rng.uniform([-6, 0, 20], [6, 2, 32], (rois, 3))
    size = rng.uniform([1, 1, 2], [2, 3, 24], (rois, 3))
    boxes = np.column_stack([centre, size, rng.uniform(-4, 4, rois)]).astype(np.float32)
    boxes[-1, 0] = 500
    return cloud, features, boxes


@given(st.integers(0, 2**32 - 1), st.integers(1, 300), st.sampled_from([0.0, 0.2, 1.0]), st.sampled_from([1, 7, 64]))
@settings(max_examples=30, deadline=None)
def test_pooled_points_are_those_of_the_plain_loop(seed: int, count: int, extra: float, nsample: int) -> None:
    cloud, features, boxes = scene(seed, count, 6)
    expected, empty = twin.roi_pool(cloud, features, boxes, extra, nsample)
    tensors = tuple(torch.from_numpy(part) for part in (cloud, features, boxes))
    pooled, flags = roi_pool(*tensors, extra, nsample)
    assert flags.tolist() == empty
    assert np.array_equal(pooled.numpy(), expected)

    regions = _turned(enlarged(tensors[2], extra))[None]
    index, flags = _torch_points.first_in_boxes(tensors[0][None], regions, 10.0, nsample)
    assert flags[0].tolist() == empty
    filled = ~flags[0]
    assert torch.equal(tensors[1][index[0]][filled], pooled[filled][..., 3:])


def test_pooling_by_hand() -> None:
    points = torch.tensor([[0.0, -0.5, 10], [5.0, -0.5, 10], [1.9, -0.5, 10], [0.0, 0.1, 10], [0.0, -1.1, 10]])
    features = torch.arange(5.0)[:, None]
    roi = torch.tensor([[0.0, 0.0, 10.0, 1.0, 2.0, 3.0, 0.0], [50.0, 0, 50, 1, 1, 1, 0]])
    tight, empty = roi_pool(points, features, roi, 0.0, 4)
    assert empty.tolist() == [False, True]
    assert tight[0, :, 3].tolist() == [0, 0, 0, 0]
    assert tight[1].abs().sum() == 0
    # 0.5 m on every side: l 4, and y from -1.5 to 0.5. Four of five points lie inside, they repeat from the first.
    wide, _ = roi_pool(points, features, roi, 0.5, 6)
    assert wide[0, :, 3].tolist() == [0, 2, 3, 4, 0, 2]
    assert wide[0, 1, :3].tolist() == pytest.approx([1.9, -0.5, 10])
    first, _ = roi_pool(points, features, roi, 0.5, 2)
    assert first[0, :, 3].tolist() == [0, 2]


def test_points_beyond_ten_metres_are_dropped_by_pooling_only() -> None:
    points = torch.tensor([[9.5, -0.5, 0.0], [10.5, -0.5, 0.0]])
    train = torch.tensor([[0.0, 0.0, 0.0, 2.0, 3.0, 24.0, 0.0]])
    pooled, _ = roi_pool(points, points, train, 0.0, 2)
    assert pooled[0, :, 0].tolist() == [9.5, 9.5]
    assert points_in_boxes(points, train).tolist() == [[True, True]]


def test_pooling_of_batches_without_gradient() -> None:
    scenes = [scene(seed, 500, 40) for seed in range(3)]
    points, features, rois = (torch.from_numpy(np.stack(parts)) for parts in zip(*scenes, strict=True))
    features.requires_grad_()
    pooled, empty = roi_pool(points, features, rois, 0.2, 32)
    assert pooled.shape == (3, 40, 32, 5)
    assert not pooled.requires_grad
    for b in range(3):
        alone, flags = roi_pool(points[b], features[b], rois[b], 0.2, 32)
        assert torch.equal(alone, pooled[b])
        assert torch.equal(flags, empty[b])


def test_no_points_or_no_regions() -> None:
    pooled, empty = roi_pool(torch.zeros(0, 3), torch.zeros(0, 2), torch.zeros(4, 7), 0.2, 8)
    assert pooled.shape == (4, 8, 5)
    assert empty.all()
    pooled, empty = roi_pool(torch.zeros(5, 3), torch.zeros(5, 2), torch.zeros(0, 7), 0.2, 8)
    assert pooled.shape == (0, 8, 5)
    assert empty.shape == (0,)
    assert points_in_boxes(np.zeros((0, 3)), np.ones((2, 7))).shape == (2, 0)
    assert points_in_boxes(torch.zeros(3, 3), torch.zeros(0, 7)).shape == (0, 3)


@given(st.integers(0, 2**32 - 1), st.integers(1, 300))
@settings(max_examples=20, deadline=None)
def test_membership_is_that_of_the_plain_loop(seed: int, count: int) -> None:
    cloud, _, boxes = scene(seed, count, 5)
    expected = [[twin.is_inside(place, box, math.inf) for place in cloud] for box in boxes]
    points, regions = torch.from_numpy(cloud), torch.from_numpy(boxes)
    assert points_in_boxes(cloud, boxes).tolist() == expected
    assert points_in_boxes(points, regions).tolist() == expected
    assert _torch_points.in_boxes(points[None], _turned(regions)[None], math.inf)[0].tolist() == expected


def test_heading_follows_kitti_and_faces_belong_to_the_box() -> None:
    # ry = -pi/2 points along +z: l lies along z.
    box = np.array([[0.0, 0.0, 10.0, 1.0, 2.0, 4.0, -math.pi / 2]])
    points = np.array([[0.0, -0.5, 11.9], [1.9, -0.5, 10.0], [0.5, 0.0, 10.0], [0.5, -1.0, 10.0], [0.5, -1.001, 10.0]])
    assert points_in_boxes(points, box).tolist() == [[True, False, True, True, False]]
    # A quarter turn to the other diagonal: the corner direction (l/2, 0) goes to x cos, -l/2 sin.
    turned = np.array([[0.0, 0.0, 10.0, 1.0, 0.2, 4.0, 0.5]])
    ahead = np.array([[1.9 * math.cos(0.5), -0.5, 10 - 1.9 * math.sin(0.5)], [1.9 * math.cos(0.5), -0.5, 11.9]])
    assert points_in_boxes(ahead, turned).tolist() == [[True, False]]


def test_wrong_input_is_named() -> None:
    points = torch.zeros(4, 3)
    with pytest.raises(ValueError, match="features: expected one row per point, got 3 rows for 4 points"):
        roi_pool(points, torch.zeros(3, 1), torch.zeros(1, 7), 0.0, 8)
    with pytest.raises(ValueError, match=r"rois: expected \(B, N, 7\)"):
        roi_pool(points, torch.zeros(4, 1), torch.zeros(1, 8), 0.0, 8)
    with pytest.raises(ValueError, match=r"points: expected \(N, 3\) float32 or float64, got int64"):
        points_in_boxes(np.zeros((4, 3), dtype=np.int64), np.zeros((1, 7)))
