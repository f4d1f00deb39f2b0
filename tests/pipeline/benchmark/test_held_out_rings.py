"""The benchmark on real frames: it must reproduce the figures of the classical peers and its own fixed points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from pipeline.benchmark.held_out_rings import HeldOutFrame, convex_hull_mask, hold_out, score
from pipeline.data import open_dataset

FRAMES = ("000003", "000008")


@pytest.fixture(scope="module")
def frames(kitti_object: Path) -> list[HeldOutFrame]:
    dataset = open_dataset("kitti_object", kitti_object)
    found = [dataset[name] for name in FRAMES]
    return [hold_out(frame.points, frame.calibration, frame.image_size, rows=16) for frame in found]


def nearest_fill(sparse: np.ndarray) -> np.ndarray:
    index = distance_transform_edt(sparse == 0, return_distances=False, return_indices=True)
    return sparse[tuple(index)]


@pytest.mark.real_data
def test_truth_itself_scores_zero(frames: list[HeldOutFrame]) -> None:
    for frame in frames:
        result = score(frame.visible, frame)
        assert result["mae"] == 0
        assert result["mixed"] == 0
        assert result["edge_tmae"] == 0


@pytest.mark.real_data
def test_constant_depth_is_capped(frames: list[HeldOutFrame]) -> None:
    values = [score(np.full(frame.truth.shape, 20.0), frame)["tmae"] for frame in frames]
    assert np.mean(values) == pytest.approx(980, abs=15)


@pytest.mark.real_data
def test_input_keeps_a_quarter_and_truth_excludes_it(frames: list[HeldOutFrame]) -> None:
    for frame in frames:
        assert not (frame.truth[frame.sparse > 0] > 0).any()
        share = (frame.sparse > 0).sum() / ((frame.sparse > 0).sum() + (frame.truth > 0).sum())
        assert 0.22 < share < 0.31
        assert 50 < len(frame.edges) < 600


@pytest.mark.real_data
def test_copying_invents_no_depth_but_linear_interpolation_does(frames: list[HeldOutFrame]) -> None:
    for frame in frames:
        assert score(nearest_fill(frame.sparse), frame)["mixed"] < 3
        smeared = nearest_fill(frame.sparse)
        for _ in range(3):
            smeared = 1 / np.mean([1 / np.roll(smeared, shift, axis=1) for shift in (-3, 0, 3)], axis=0)
        assert score(smeared, frame)["mixed"] > 25


def test_holes_take_the_nearest_prediction_and_are_reported() -> None:
    truth = np.zeros((20, 40), np.float32)
    truth[10, 5:35:5] = 10.0
    frame = HeldOutFrame(truth, truth, truth, np.ones_like(truth, bool), np.zeros((0, 4)), np.zeros(0, bool))
    half = np.full(truth.shape, 10.5)
    half[:, 20:] = 0
    result = score(half, frame)
    assert result["mae"] == pytest.approx(500)
    assert result["missing"] == pytest.approx(50)
    assert np.isnan(result["mixed"])


def test_convex_hull_of_a_triangle() -> None:
    mask = np.zeros((11, 11), bool)
    mask[0, 0] = mask[10, 0] = mask[0, 10] = True
    hull = convex_hull_mask(mask)
    assert hull[2, 2]
    assert not hull[8, 8]
    assert hull.sum() == 66  # 11 + 10 + ... + 1
