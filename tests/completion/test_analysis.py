"""Error maps, regions, distances, sharpness and figures on small maps counted by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from completion import analysis
from completion.figures import plot_expected_losses


def test_expected_loss_of_two_depths() -> None:
    found = analysis.expected_loss(np.abs, np.array([10.0, 11.5, 13.0]), (10.0, 13.0), (0.5, 0.5))
    assert found.tolist() == [1.5, 1.5, 1.5]  # MAE does not mind a mixed depth
    thresholded = analysis.expected_loss(
        lambda e: np.minimum(abs(e), 1), np.array([10.0, 11.5]), (10.0, 13.0), (0.5, 0.5)
    )
    assert thresholded.tolist() == [0.5, 1.0]  # tMAE does
    with pytest.raises(ValueError, match="summing to 1"):
        analysis.expected_loss(np.abs, 0.0, (1.0, 2.0), (0.5, 0.6))


def test_relative_error_maps_and_counts() -> None:
    target = np.array([[10.0, 10.0, 0.0]], np.float32)
    baseline = np.array([[12.0, 10.5, 3.0]], np.float32)
    ours = np.array([[11.0, 12.0, 3.0]], np.float32)
    A, S = analysis.relative_error_maps(baseline, ours, target)
    assert A[0, :2].tolist() == [1.0, -1.5]
    assert S[0, :2].tolist() == [3.0, -3.75]
    assert np.isnan(A[0, 2])
    edges, improved, worsened = analysis.relative_error_histograms([A], bins=10)
    assert improved.sum() == worsened.sum() == 1
    assert edges[0] == pytest.approx(1e-3)
    assert edges[-1] >= 1.5


def test_edge_region_is_closer_than_three_pixels() -> None:
    foreground = np.zeros((5, 12), bool)
    foreground[:, 6:] = True
    edge = analysis.edge_region(foreground)
    assert np.flatnonzero(edge[2]).tolist() == [4, 5, 6, 7]
    assert not analysis.edge_region(np.zeros((4, 4), bool)).any()


def test_region_metrics_split_the_image() -> None:
    foreground = np.zeros((4, 12), bool)
    foreground[:, 6:] = True
    target = np.full((4, 12), 10.0, np.float32)
    prediction = target.copy()
    prediction[:, 4:8] += 0.5
    found = analysis.region_metrics(prediction, target, foreground)
    assert found["edge"]["mae_mm"] == pytest.approx(500)
    assert found["inside"]["mae_mm"] == 0
    assert found["whole"]["mae_mm"] == pytest.approx(500 / 3)


def step_edge() -> np.ndarray:
    target = np.full((12, 20), 10.0, np.float32)
    target[:, 10:] = 30.0
    return target


def test_mixed_share_counts_depths_between_two_surfaces() -> None:
    target = step_edge()
    assert analysis.mixed_share(target, target) == 0
    assert analysis.mixed_share(np.full_like(target, 20.0), target) == 1
    wrong_side = np.where(target == 10, 30, 10).astype(np.float32)
    assert analysis.mixed_share(wrong_side, target) == 0  # wrong, but a surface that exists
    half = target.copy()
    half[:6] = 20.0
    assert analysis.mixed_share(half, target) == pytest.approx(0.5)
    assert np.isnan(analysis.mixed_share(target, np.full_like(target, 10.0)))


def test_mixed_share_with_a_sparse_target_and_no_prediction() -> None:
    target = step_edge()
    target[::2] = 0
    assert analysis.mixed_share(np.full_like(target, 20.0), target) == 1
    prediction = np.full_like(target, 20.0)
    prediction[:, :10] = 0
    assert analysis.mixed_share(prediction, target) == 1


def test_figures_are_drawn(tmp_path: Path) -> None:
    assert plot_expected_losses(tmp_path / "expected.png").stat().st_size > 10_000
