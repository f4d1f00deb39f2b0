"""Which true depth completion is scored on."""

from __future__ import annotations

import numpy as np

from pipeline.data import Frame
from pipeline.scoring.scores import scored_depth


def frame_with(target: np.ndarray) -> Frame:
    sparse = np.zeros(target.shape, np.float32)
    sparse[40:, ::2] = 20.0
    parts = {
        "image": lambda: np.zeros((*target.shape, 3), np.uint8),
        "sparse_depth": lambda: sparse,
        "target_depth": lambda: target,
    }
    return Frame("000000", parts)


def test_truth_measured_by_a_lidar_is_scored_whole() -> None:
    target = np.zeros((100, 60), np.float32)
    target[5:80:4] = 95.0
    np.testing.assert_array_equal(scored_depth(frame_with(target)), target)


def test_dense_truth_is_scored_where_a_lidar_measures() -> None:
    target = np.full((100, 60), 20.0, np.float32)
    target[60:70] = 95.0
    scored = scored_depth(frame_with(target))
    assert not scored[:40].any(), "above the topmost sample"
    assert not scored[60:70].any(), "beyond 80 m"
    assert (scored[40:60] == 20).all()
    assert (scored[70:] == 20).all()
