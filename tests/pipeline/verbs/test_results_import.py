"""Result pickles of OpenPCDet and mmdetection3d, with and without 2D boxes."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from detection.evaluation.kitti_ap import evaluate
from detection.kitti_format import KittiObject, format_line, parse_lines
from pipeline.base.errors import DataError
from pipeline.verbs.import_ import import_results

CAR = KittiObject("Car", 0, 0, -1.5, (100, 100, 180, 160), (1.5, 1.6, 3.9), (1.0, 1.7, 20.0), -1.45)


def entry(count: int, **more: Any) -> dict[str, Any]:
    """One frame of `count` cars in the fields that both programs share."""
    return {
        "name": np.array(["Car"] * count),
        "alpha": np.full(count, -1.5),
        "bbox": np.tile([100.0, 100, 180, 160], (count, 1)),
        "dimensions": np.tile([3.9, 1.5, 1.6], (count, 1)),
        "location": np.tile([1.0, 1.7, 20.0], (count, 1)),
        "rotation_y": np.full(count, -1.45),
        "score": np.linspace(0.9, 0.5, count).astype(np.float32),
        **more,
    }


def imported(tmp_path: Path, content: Any) -> dict[str, list[KittiObject]]:
    (tmp_path / "result.pkl").write_bytes(pickle.dumps(content))
    import_results(tmp_path / "result.pkl", tmp_path / "out")
    return {path.stem: parse_lines(path.read_text(), scored=True) for path in sorted((tmp_path / "out").iterdir())}


@pytest.mark.parametrize("name", [0, "0", "000000", np.int64(0), np.array(0)])
def test_a_frame_is_called_as_kitti_calls_it(tmp_path: Path, name: Any) -> None:
    (objects,) = imported(tmp_path, [entry(2, frame_id=name)]).items()
    assert objects[0] == "000000"
    assert [o.size for o in objects[1]] == [CAR.size] * 2
    assert objects[1][0].location == CAR.location


@pytest.mark.parametrize("wrapped", [False, True])
def test_mmdetection3d_names_frames_once_per_object(tmp_path: Path, wrapped: bool) -> None:
    frames = [entry(3, sample_idx=np.full(3, 7)), entry(1, sample_idx=np.array([134]))]
    found = imported(tmp_path, {"pred_instances_3d": frames} if wrapped else frames)
    assert {name: len(objects) for name, objects in found.items()} == {"000007": 3, "000134": 1}
    assert found["000007"][0].score == pytest.approx(0.9)


def test_results_without_2d_boxes_count_only_under_another_rule(tmp_path: Path) -> None:
    frames = []
    for index in range(45):
        frame = entry(1, frame_id=index)
        del frame["bbox"], frame["alpha"]
        frames.append(frame)
    found = imported(tmp_path, frames)
    assert found["000044"][0].bbox == (0, 0, 0, 0)
    assert found["000044"][0].alpha == -10
    (tmp_path / "labels").mkdir()
    for name in found:
        (tmp_path / "labels" / f"{name}.txt").write_text(format_line(CAR) + "\n")
    asked: dict[str, Any] = {"classes": ["Car"], "metrics": ["3d"], "iou_set": "strict"}
    by_kitti = evaluate(tmp_path / "labels", tmp_path / "out", **asked)
    assert by_kitti["results"][0]["moderate"] == 0
    report = evaluate(tmp_path / "labels", tmp_path / "out", min_height="none", **asked)
    assert report["results"][0]["moderate"] == pytest.approx(100)
    assert any("not KITTI's ranking" in text for text in report["warnings"])
    assert report["protocol"]["min_height"] == "none"


def test_labels_without_2d_boxes_count_under_that_rule(tmp_path: Path) -> None:
    frames = {
        f"{i:06d}": [KittiObject("Car", 0, 0, -10, (0, 0, 0, 0), CAR.size, CAR.location, CAR.ry)] for i in range(41)
    }
    found = {name: [KittiObject(*(getattr(o, f) for f in ("type", "truncated", "occluded", "alpha")),
                                (-1, -1, -1, -1), o.size, o.location, o.ry, 0.5) for o in objects]
             for name, objects in frames.items()}  # fmt: skip
    asked: dict[str, Any] = {"classes": ["Car"], "metrics": ["bev"], "iou_set": "strict"}
    assert evaluate(frames, found, **asked)["results"][0]["n_gt"] == [0, 0, 0]
    assert evaluate(frames, found, min_height="none", **asked)["results"][0]["moderate"] == pytest.approx(100)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ([entry(2, frame_id=3, score=np.array([0.5, np.nan]))], r"frame 000003: expected finite numbers as score"),
        ([entry(1, frame_id=3), entry(1, frame_id="000003")], "every frame once, got frame 000003 again"),
        ([{"frame_id": 3, "name": ["Car"]}], "no dimensions, location, rotation_y, score"),
        ([{"frame_id": 3, "name": ["Car"], "boxes_lidar": np.zeros((1, 7))}], "need each frame's calibration"),
        ([entry(1)], r"a frame's name \(frame_id, sample_idx, image_idx\)"),
        ({"metainfo": 1}, "a list of frames, got dict"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path: Path, content: Any, words: str) -> None:
    with pytest.raises(DataError, match=words):
        imported(tmp_path, content)
