"""Which true depth completion is scored on; AP by the protocol of the run."""

from __future__ import annotations

import numpy as np

from detection.evaluation.kitti_ap import evaluate
from detection.evaluation.protocol import EvaluationProtocol
from pipeline.data import Frame
from pipeline.run_folder.config import load_config
from pipeline.scoring.scores import Collected, scored_depth, scores
from tests.detection.evaluation.scenes import random_frames


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


def test_a_run_is_scored_by_its_own_protocol_with_the_numbers_of_the_library() -> None:
    labels, detections = (dict(enumerate(items)) for items in random_frames(9, 30))
    collected = Collected({str(k): v for k, v in labels.items()}, {str(k): v for k, v in detections.items()})
    overrides = ["flavor=python", "ranges=[[0, 30], [30, null]]", "metrics=[bev]", "classes=[Car]", "ious={Car: [0.3]}"]
    config = load_config("kitti", [f"evaluation.{text}" for text in overrides])
    rows = scores(config, collected)["results"]
    asked = EvaluationProtocol(("Car",), ("bev",), flavor="python", ranges=((0, 30), (30, None)), ious={"Car": (0.3,)})
    assert rows == evaluate(collected.labels, collected.detections, asked)["results"]
    assert (
        rows
        == evaluate(
            collected.labels,
            collected.detections,
            classes=["Car"],
            metrics=["bev"],
            flavor="python",
            ranges=[(0, 30), (30, None)],
            ious={"Car": [0.3]},
        )["results"]
    )
    assert [row["range"] for row in rows] == [[0, 30], [30, None]]
    assert any(row["hard"] for row in rows), rows
