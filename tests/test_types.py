"""The values that travel between the rooms check themselves when they are built."""

from __future__ import annotations

import numpy as np
import pytest

from completion.types import CompletedDepth, DepthFrame
from detection.types import Boxes3D, Detections, PointFrame

IMAGE = np.zeros((4, 6, 3), np.uint8)
DEPTH = np.ones((4, 6), np.float32)


def test_a_depth_frame_takes_maps_of_one_size() -> None:
    frame = DepthFrame(IMAGE, DEPTH.astype(np.float64), DEPTH * 2, np.eye(3))
    assert frame.size == (4, 6)
    assert frame.sparse.dtype == np.float32


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((IMAGE[:, :, :1], DEPTH), r"image: expected \(H, W, 3\) uint8 RGB"),
        ((IMAGE.astype(np.float32), DEPTH), "dtype float32"),
        ((IMAGE, DEPTH[1:]), r"sparse: expected shape \(4, 6\).*got \(3, 6\)"),
        ((IMAGE, DEPTH * np.nan), "sparse: 24 values are NaN"),
        ((IMAGE, -DEPTH), "smallest value is -1 m"),
        ((IMAGE, DEPTH, DEPTH[None]), "target: expected an"),
        ((IMAGE, DEPTH, None, np.eye(4)), r"K: expected a \(3, 3\)"),
    ],
)
def test_wrong_depth_frames_are_refused(arguments, message) -> None:
    with pytest.raises(ValueError, match=message):
        DepthFrame(*arguments)


def test_completed_depth_has_all_surfaces_or_none() -> None:
    assert not CompletedDepth(DEPTH).has_surfaces
    assert CompletedDepth(DEPTH, DEPTH, DEPTH * 2, DEPTH * 0.5).has_surfaces
    with pytest.raises(ValueError, match="belong together"):
        CompletedDepth(DEPTH, foreground=DEPTH)
    with pytest.raises(ValueError, match="it is a weight"):
        CompletedDepth(DEPTH, DEPTH, DEPTH, DEPTH * 1.5)
    with pytest.raises(ValueError, match="background: expected shape"):
        CompletedDepth(DEPTH, DEPTH, DEPTH[:2], DEPTH)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.zeros((3, 2))}, r"points: expected \(N, 3 or more\)"),
        ({"points": np.full((3, 4), np.inf)}, "3 of 3 points hold NaN or infinite"),
        ({"T_cam_velo": np.eye(3)}, "T_cam_velo: expected shape"),
        ({"P2": np.eye(4)}, "P2: expected shape"),
    ],
)
def test_wrong_point_frames_are_refused(change, message) -> None:
    good = {"points": np.zeros((3, 4)), "T_cam_velo": np.eye(4), "P2": np.eye(3, 4), "image_size": (4, 6)}
    assert PointFrame(**good).points.dtype == np.float32
    with pytest.raises(ValueError, match=message):
        PointFrame(**{**good, **change})


def test_boxes_name_their_columns() -> None:
    boxes = Boxes3D(np.arange(14.0).reshape(2, 7))
    np.testing.assert_array_equal(boxes.bottom_centre, [[0, 1, 2], [7, 8, 9]])
    np.testing.assert_array_equal(boxes.size, [[3, 4, 5], [10, 11, 12]])
    np.testing.assert_array_equal(boxes.ry, [6, 13])
    assert len(Boxes3D.empty()) == 0
    assert len(Boxes3D(np.array([]))) == 0
    with pytest.raises(ValueError, match=r"expected \(N, 7\)"):
        Boxes3D(np.zeros((2, 6)))
    with pytest.raises(ValueError, match="NaN"):
        Boxes3D(np.full((1, 7), np.nan))


def test_detections_are_selected_together() -> None:
    detections = Detections(Boxes3D(np.arange(21.0).reshape(3, 7)), ("Car", "Van", "Tram"), np.array([0.1, 0.9, 0.5]))
    best = detections.select(np.argsort(-detections.scores)[:2])
    assert best.classes == ("Van", "Tram")
    np.testing.assert_array_equal(best.boxes.values[:, 0], [7, 14])
    assert detections.select(detections.scores > 0.8).classes == ("Van",)
    assert len(Detections.empty().select([])) == 0
    with pytest.raises(ValueError, match="1 boxes, 2 classes and 1 scores differ"):
        Detections(Boxes3D(np.zeros((1, 7))), ("a", "b"), np.zeros(1))
    with pytest.raises(ValueError, match="NaN or infinite scores"):
        Detections(Boxes3D(np.zeros((1, 7))), ("a",), np.array([np.nan]))
