"""Masks against boxes: points counted by hand, and true masks of synthetic streets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from detection.kitti_format import KittiObject
from pipeline.base.errors import UsageError
from pipeline.benchmark import mask_points
from pipeline.benchmark.mask_points import PointCounts, count_points, mask_scores
from pipeline.data import open_dataset
from pipeline.data.frame import Frame
from pipeline.geometry.calibration import Calibration
from pipeline.semantics.sources import open_semantics
from pipeline.simulation.synth import SynthSettings
from pipeline.simulation.writers import write_dataset

CAR = KittiObject("Car", 0.0, 0, 0.0, (0, 0, 9, 9), (1.5, 1.6, 4.0), (0.0, 1.5, 10.0), 0.0)
REGION = KittiObject("DontCare", -1, -1, -10, (70, 0, 99, 49), (-1, -1, -1), (-1000, -1000, -1000), -10)


def frame_of(camera: list[tuple[float, float, float]]) -> Frame:
    """A frame of 50 x 100 pixels with these points, camera axes; focal length 100 pixels, centre (50, 25)."""
    turn = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # LiDAR axes -> camera axes
    T_cam0_velo = np.eye(4)
    T_cam0_velo[:3, :3] = turn
    P2 = np.array([[100.0, 0, 50, 0], [0, 100, 25, 0], [0, 0, 1, 0]])
    calibration = Calibration(P2, np.eye(3), T_cam0_velo)
    points = np.column_stack([np.array(camera) @ turn, np.zeros(len(camera))]).astype(np.float32)
    parts = {
        "points": lambda: points,
        "calibration": lambda: calibration,
        "labels": lambda: [CAR, REGION],
        "image": lambda: np.zeros((50, 100, 3), np.uint8),
    }
    return Frame("1", parts)


def test_points_counted_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mask_points, "visible_points", lambda points, *rest: np.ones(len(points), bool))
    frame = frame_of(
        [
            (0.0, 1.0, 10.0),  # in the box, pixel (35, 50): under the mask
            (1.0, 1.0, 10.0),  # in the box, pixel (35, 60): missed by the mask
            (0.0, 1.4, 10.0),  # in the box's lowest 0.2 m, under the mask: not counted
            (0.0, 2.0, 20.0),  # behind the box, pixel (35, 50): under the mask
            (-2.0, 0.0, 20.0),  # behind the box, pixel (25, 40): neither
            (2.5, 0.0, 10.0),  # pixel (25, 75), masked, but in the DontCare region
        ]
    )
    semantics = np.full((50, 100), 255, np.uint8)
    semantics[30:45, 45:55] = semantics[:, 70:] = 13
    counts = count_points(frame, semantics)
    assert counts == {"vehicles": PointCounts(both=1, masked=2, boxed=2), "people": PointCounts()}
    assert counts["vehicles"].shares == {"recall": 1 / 2, "precision": 1 / 2, "iou": 1 / 3}
    assert counts["people"].shares == {"recall": None, "precision": None, "iou": None}


def test_true_masks_agree_with_boxes_and_filled_boxes_leak(tmp_path: Path) -> None:
    write_dataset(tmp_path, SynthSettings(frames=3, seed=5))
    told: list[str] = []
    sources = {name: open_semantics(name) for name in ("truth", "boxes")}
    found = mask_scores(open_dataset("kitti_object", tmp_path), sources, told.append)
    true, filled = (entry for entry in found if entry["group"] == "vehicles")
    assert (true["mask"], filled["mask"], len(told)) == ("truth", "boxes", 6)
    assert true["boxed"] == filled["boxed"] > 500
    assert true["iou"] > 0.8
    assert filled["recall"] > 0.97
    assert filled["precision"] < true["precision"] - 0.1


def test_scores_are_no_masks(tmp_path: Path) -> None:
    write_dataset(tmp_path, SynthSettings(frames=1, seed=5))
    with pytest.raises(UsageError, match="not of scores"):
        mask_scores(open_dataset("kitti_object", tmp_path), {"soft": open_semantics("soft")}, print)
