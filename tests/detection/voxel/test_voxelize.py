"""Voxelisation: order, caps, borders."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from detection.ops.voxelize import VoxelGrid, voxelize
from tests.reference.voxel_sparse import voxelize_loop

GRID = VoxelGrid((0, -2, -1), (4, 2, 1), (1, 1, 2), max_points=2, max_voxels=(3, 6))
# Eighths are exact in float32, so that both sides agree on every border.
EIGHTH = st.integers(-20, 40).map(lambda value: value / 8)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(EIGHTH, EIGHTH, EIGHTH, st.integers(0, 9).map(float)), max_size=40), st.integers(1, 8))
def test_voxels_equal_the_loop(rows, max_voxels) -> None:
    points = torch.tensor(rows, dtype=torch.float32).view(-1, 4)
    coords, members = voxelize_loop(points.tolist(), GRID.low, GRID.size, GRID.shape, GRID.max_points, max_voxels)
    voxels = voxelize(points, GRID, max_voxels)
    assert voxels.coords.tolist() == [list(place) for place in coords]
    assert voxels.counts.tolist() == [len(own) for own in members]
    for filled, own in zip(voxels.points, members):
        assert filled[: len(own)].tolist() == own
        assert not filled[len(own) :].any()


def test_worked_example_with_both_caps() -> None:
    points = torch.tensor([[3.5, 0, 0], [0.5, 0, 0], [3.6, 0, 0], [3.7, 0, 0], [1.5, 0, 0], [0.6, 0, 0], [4.0, 0, 0]])
    voxels = voxelize(points, GRID, 2)
    assert GRID.shape == (1, 4, 4)
    assert voxels.coords.tolist() == [[0, 2, 3], [0, 2, 0]]
    assert voxels.counts.tolist() == [2, 2]
    np.testing.assert_allclose(voxels.points[..., 0], [[3.5, 3.6], [0.5, 0.6]])


def test_crop_leaves_z_alone_and_centres_follow_the_stride() -> None:
    points = torch.tensor([[1.0, 1, 99], [4.0, 2, 0], [4.1, 0, 0], [1, -2.1, 0]])
    assert GRID.crop(points).tolist() == [[1.0, 1, 99], [4.0, 2, 0]]
    assert GRID.centres(torch.tensor([[0, 1, 3]])).tolist() == [[3.5, -0.5, 0.0]]
    assert GRID.centres(torch.tensor([[0, 1, 1]]), stride=2).tolist() == [[3.0, 1.0, 1.0]]


def test_no_points_no_voxels_and_a_wrong_shape_is_named() -> None:
    assert len(voxelize(torch.zeros(0, 4), GRID, 5).coords) == 0
    with pytest.raises(ValueError, match="x y z"):
        voxelize(torch.zeros(3, 2), GRID, 5)
