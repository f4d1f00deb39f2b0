"""Corners in which public evaluators differ: an overlap of exactly the limit, negative sizes, occlusion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from detection.evaluation.kitti_ap import evaluate
from detection.evaluation.reading import read_pair
from detection.kitti_format import KittiObject, format_line

LABEL = KittiObject("Car", 0, 0, 0.0, (100, 100, 200, 200), (1.5, 1.6, 4.0), (0.0, 1.7, 20.0), 0.0)
STRICT: dict[str, Any] = {"classes": ["Car"], "iou_set": "strict"}


def moderate(label: KittiObject, detection: KittiObject, metric: str, **asked: Any) -> float | None:
    """AP of 41 equal frames: 100 when the detection matches the label, else 0."""
    frames = {f"{index:06d}": [label] for index in range(41)}
    found = {name: [replace(detection, score=0.5)] for name in frames}
    value = evaluate(frames, found, metrics=[metric], **STRICT | asked)["results"][0]["moderate"]
    return None if value is None else round(value, 6)


@pytest.mark.parametrize(("bottom", "expected"), [(170, 0), (170.001, 100), (169.999, 0)])
def test_a_match_in_the_image_needs_more_than_the_limit(bottom: float, expected: float) -> None:
    # 100 x 70 of 100 x 100 pixels: the devkit's double arithmetic gives 0.7 exactly, which is not more than 0.7.
    assert moderate(LABEL, replace(LABEL, bbox=(100, 100, 200, bottom)), "2d") == expected


@pytest.mark.parametrize(("length", "expected"), [(2.0, 0), (2.001, 100), (1.999, 0)])
def test_a_match_from_above_needs_more_than_the_limit(length: float, expected: float) -> None:
    # Half of the label's length at the same centre covers exactly half of the union.
    detection = replace(LABEL, size=(1.5, 1.6, length))
    assert moderate(LABEL, detection, "bev", ious={"Car": [0.5]}) == expected


@pytest.mark.parametrize("metric", ["bev", "3d"])
@pytest.mark.parametrize("size", [(1.5, 1.6, -4.0), (1.5, -1.6, 4.0), (1.5, -1.6, -4.0)])
def test_a_negative_length_or_width_is_the_same_rectangle(metric: str, size: tuple[float, float, float]) -> None:
    assert moderate(replace(LABEL, size=size), LABEL, metric) == 100
    assert moderate(LABEL, replace(LABEL, size=size), metric) == 100


def test_occlusion_written_as_a_fraction_moves_no_column(tmp_path: Path) -> None:
    for part, score in (("l", ""), ("d", " 0.9")):
        (tmp_path / part).mkdir()
        text = format_line(LABEL).replace("Car 0.00 0 ", "Car 0.00 1.00 ") + score
        (tmp_path / part / "000000.txt").write_text(text)
    values = read_pair(tmp_path / "l", tmp_path / "d").labels.values[0]
    assert values[:7].tolist() == [0, 1, 0, 100, 100, 200, 200]
    report = evaluate(tmp_path / "l", tmp_path / "d", metrics=["2d"], **STRICT)
    assert report["results"][0]["n_gt"] == [0, 1, 1]
