"""Detections as KITTI result lines."""

from __future__ import annotations

import math

import numpy as np
import pytest

from detection.kitti_format import format_line, parse_lines
from detection.results import result_objects
from detection.types import Boxes3D, Detections, PointFrame
from tests.detection.scenes import IMAGE_SIZE, P2, T_CAM_VELO

FRAME = PointFrame(np.zeros((1, 4), np.float32), T_CAM_VELO, P2, IMAGE_SIZE, "f")
CAR = [2.0, 1.7, 20.0, 1.5, 1.6, 4.0, 0.3]


def detections(*boxes: list[float]) -> Detections:
    return Detections(Boxes3D(np.array(boxes)), ("Car",) * len(boxes), np.linspace(1.5, -2, len(boxes)))


def test_line_by_hand() -> None:
    item = result_objects(detections([0.0, 1.0, 20.0, 1.0, 2.0, 4.0, 0.0]), FRAME)[0]
    # Nearest face at z = 19: x -2..2, y 0..1; u = (721.5 x + 609.6 z + 44.86) / (z + 0.002746).
    depth = 19.002746
    left, right = ((721.5 * x + 609.6 * 19 + 44.86) / depth for x in (-2, 2))
    bottom = (721.5 + 172.9 * 19 + 0.2163) / depth
    far_top = (172.9 * 21 + 0.2163) / 21.002746
    top = min((172.9 * 19 + 0.2163) / depth, far_top)
    assert item.bbox == pytest.approx((left, top, right, bottom))
    assert item.alpha == pytest.approx(0.0)
    assert (item.truncated, item.occluded, item.score) == (-1, -1, 1.5)
    assert result_objects(detections(CAR), FRAME)[0].alpha == pytest.approx(0.3 - math.atan2(2, 20))


def test_text_can_be_read_again_and_keeps_negative_scores() -> None:
    found = result_objects(detections(CAR, [*CAR[:2], 30.0, *CAR[3:]]), FRAME)
    text = "".join(f"{format_line(item)}\n" for item in found)
    items = parse_lines(text, scored=True)
    assert [item.score for item in items] == [1.5, -2.0]
    assert items[0].location == pytest.approx((2.0, 1.7, 20.0))
    assert result_objects(Detections.empty(), FRAME) == []


def test_boxes_are_clipped_and_huge_or_invisible_ones_dropped() -> None:
    at_edge, huge, outside = [9.0, 1.7, 10.0, *CAR[3:]], [0.0, 1.7, 2.2, *CAR[3:]], [30.0, 1.7, 10.0, *CAR[3:]]
    items = result_objects(detections(at_edge, huge, outside), FRAME)
    assert len(items) == 1
    assert items[0].bbox[2] == IMAGE_SIZE[1] - 1
