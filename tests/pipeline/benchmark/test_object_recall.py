"""Recall and precision on scenes small enough to count by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest

from detection.kitti_format import KittiObject
from pipeline.benchmark.object_recall import level_of, object_recall

CAR = KittiObject("Car", 0.0, 0, 0.0, (100, 100, 200, 150), (1.5, 1.6, 4.0), (0.0, 1.6, 15.0), 0.1)


def found(item: KittiObject, score: float = 1.0, **changes: object) -> KittiObject:
    return replace(item, score=score, type="Car", **changes)  # type: ignore[arg-type]


def at(x: float, z: float, **changes: object) -> KittiObject:
    return replace(CAR, location=(x, 1.6, z), **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "level"),
    [
        ({}, 0),
        ({"bbox": (0.0, 100.0, 50.0, 139.0)}, 1),
        ({"occluded": 1}, 1),
        ({"occluded": 2}, 2),
        ({"truncated": 0.4}, 2),
        ({"truncated": 0.6}, None),
        ({"bbox": (0.0, 100.0, 50.0, 124.0)}, None),
    ],
)
def test_level(changes: dict[str, object], level: int | None) -> None:
    assert level_of(replace(CAR, **changes)) == level  # type: ignore[arg-type]


def test_counts_by_level_and_distance() -> None:
    near, occluded, far = at(0, 15), at(5, 30, occluded=2), at(-5, 50)
    report = object_recall([[near, occluded, far]], [[found(near), found(far)]], iou=0.5)
    assert (report.by_level["easy"].found, report.by_level["easy"].total) == (2, 2)
    assert (report.by_level["hard"].found, report.by_level["hard"].total) == (2, 3)
    assert report.by_distance[(20.0, 40.0)].found == 0
    assert report.by_distance[(40.0, 70.0)].share == 1.0
    assert report.precision == 1.0


def test_duplicates_and_clutter_are_false_but_vans_and_dontcare_are_not() -> None:
    van = at(5, 30, type="Van")
    region = replace(CAR, type="DontCare", bbox=(500, 100, 700, 200), location=(-1000.0, -1000.0, -1000.0))
    reported = [
        found(CAR, 0.9),
        found(CAR, 0.8),
        found(van, 0.7),
        found(at(20, 60), 0.6),
        found(at(-20, 60), 0.5, bbox=(520.0, 110.0, 600.0, 150.0)),
    ]
    report = object_recall([[CAR, van, region]], [reported], iou=0.5)
    assert report.true_detections == 1
    assert report.false_detections == 2
    assert report.precision == pytest.approx(1 / 3)


def test_score_threshold_and_higher_iou() -> None:
    shifted = found(at(0.0, 15.6), 0.4)
    # 4 m long, 1.6 m wide, moved 0.6 m across the width: IoU = 1.0 / 2.2 from above, less the small turn.
    assert object_recall([[CAR]], [[shifted]], iou=0.4).by_level["easy"].found == 1
    assert object_recall([[CAR]], [[shifted]], iou=0.5).by_level["easy"].found == 0
    assert object_recall([[CAR]], [[shifted]], iou=0.4, score_threshold=0.5).by_level["easy"].found == 0
