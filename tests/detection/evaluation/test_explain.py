"""Reasons per object on scenes made for each, and the causes of zero AP on sets spoilt in each known way."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from detection.evaluation.diagnose import likely_causes
from detection.evaluation.explain import Explanation, explain, orientation_errors, sum_reasons
from detection.evaluation.kitti_ap import prepare
from detection.kitti_format import KittiObject
from tests.detection.evaluation.scenes import dontcare, random_frames, thing


def stories(labels: list[KittiObject], detections: list[KittiObject], level: int = 1, **options) -> dict:
    """(side, line) -> explanation of one frame, Car in 3D at IoU 0.7."""
    evaluation = prepare([labels], [detections], classes=["Car"], metrics=["3d"], iou_set="strict", **options)
    found = explain(evaluation.matcher, evaluation.targets[0], level)
    return {(item.side, item.line): item for item in found}


def verdict(item: Explanation) -> tuple[str, str]:
    return item.status, item.reason


def test_every_reason_of_a_label() -> None:
    labels = [
        thing(x=0),
        thing(x=10),
        thing(x=20),
        thing(x=30),
        thing("Van", x=40),
        thing("Cyclist", x=50),
        dontcare((0, 0, 50, 50)),
        thing(x=60, occluded=2),
        thing(x=70, truncated=0.4),
        thing(x=80, height=20, occluded=3),
        thing(x=90, z=20),
    ]
    detections = [
        thing(x=0, score=0.9),
        thing(x=11, score=0.8),
        thing("Cyclist", x=30, score=0.5, size=(1.5, 1.6, 3.9)),
        thing(x=90, score=0.4, height=10),
    ]
    found = stories(labels, detections)
    expected = [
        ("matched", "found"),
        ("missed", "IoU too low"),
        ("missed", "no detection overlaps"),
        ("missed", "wrong class"),
        ("ignored", "neighbouring class"),
        ("ignored", "other class"),
        ("ignored", "DontCare area"),
        ("ignored", "occluded"),
        ("ignored", "truncated"),
        ("ignored", "occluded and height under limit"),
        ("ignored", "found by an ignored detection"),
    ]
    assert [verdict(found["label", line]) for line in range(1, 12)] == expected
    assert "IoU 1.000" in found["label", 1].detail
    # Moved by 1 m at a yaw of 0.3: the value is in the text, and below the limit.
    assert "line 2, IoU 0.4" in found["label", 2].detail
    assert found["label", 10].detail == "3 > 1, 20.00 of 25 px"
    assert str(found["label", 3]) == "000000 label 3 Car: missed, no detection overlaps"


def test_every_reason_of_a_detection() -> None:
    labels = [thing(x=0), thing(x=20, occluded=3), thing("Truck", x=40), thing(x=60)]
    detections = [
        thing(x=0, score=0.9),
        thing(x=0.1, score=0.8),
        thing(x=20, score=0.7),
        thing(x=40, score=0.6, size=(3.2, 2.6, 9.0)),
        thing(x=61.5, score=0.5),
        thing(x=-30, score=0.4),
        thing(x=60, score=0.3, height=12),
        thing("Pedestrian", x=80, score=0.2),
    ]
    found = stories(labels, detections)
    assert [verdict(found["detection", line]) for line in range(1, 9)] == [
        ("matched", "finds a label"),
        ("false positive", "label found by another detection"),
        ("ignored", "finds an ignored label"),
        ("false positive", "wrong class"),
        ("false positive", "IoU too low"),
        ("false positive", "nothing there"),
        ("ignored", "height under limit"),
        ("ignored", "other class"),
    ]


def test_ranges_and_dontcare_are_named() -> None:
    found = stories([thing(z=20), thing(x=9, z=40)], [thing(x=9, z=40, score=0.5)], ranges=[(0, 30)])
    assert verdict(found["label", 2]) == ("ignored", "out of range")
    assert verdict(found["detection", 1]) == ("ignored", "out of range")
    evaluation = prepare([[dontcare((500, 100, 900, 300))]], [[thing(score=0.5)]], classes=["Car"], metrics=["2d"])
    lines = explain(evaluation.matcher, evaluation.targets[0], 1)
    assert verdict(lines[1]) == ("ignored", "in a DontCare area")


def test_reasons_add_up_and_agree_with_the_counts() -> None:
    labels, detections = random_frames(11, 30)
    evaluation = prepare(labels, detections, iou_set="strict")
    for target in evaluation.targets:
        for level in range(3):
            lines = explain(evaluation.matcher, target, level)
            assert len(lines) == sum(map(len, labels)) + sum(map(len, detections))
            sums = sum_reasons(lines)
            assert sum(count for *_, count in sums) == len(lines)
            records = evaluation.records[target][level]
            by_status: Counter[tuple[str, str]] = Counter()
            for side, status, _, count in sums:
                by_status[side, status] += count
            assert by_status["label", "matched"] == by_status["detection", "matched"] == records.tp.sum()
            assert by_status["detection", "false positive"] == records.fp.sum()
            # Labels found by an ignored detection are neither matched nor missed.
            assert by_status["label", "matched"] + by_status["label", "missed"] <= records.n_labels.sum()


def test_orientation_errors_by_hand() -> None:
    labels = [[thing(), thing(x=8)]]
    turned = [[thing(score=1, alpha=0.3 + math.radians(10)), thing(x=8, score=1, alpha=0.3 + math.pi)]]
    evaluation = prepare(labels, turned, classes=["Car"], metrics=["3d"])
    mean, share = orientation_errors(evaluation.matcher, evaluation.targets[0], 1)
    assert mean == pytest.approx((10 + 180) / 2)
    assert share == 50
    evaluation = prepare(labels, [[thing(x=50, score=1)]], classes=["Car"], metrics=["3d"])
    assert orientation_errors(evaluation.matcher, evaluation.targets[0], 1) is None


def cars(count: int = 20) -> list[list[KittiObject]]:
    rng = np.random.default_rng(8)
    return [
        [thing(x=float(rng.uniform(-5, 5)), z=float(rng.uniform(10, 30)), ry=float(rng.uniform(0.4, 1.1)))]
        for _ in range(count)
    ]


def lidar_form(d: KittiObject) -> KittiObject:
    (x, y, z), (h, w, l) = d.location, d.size
    return replace(d, location=(z, -x, -(y - h / 2)), size=(l, w, h), ry=-d.ry - math.pi / 2)


SPOILT = {
    "yaw has the wrong sign": lambda d: replace(d, ry=-d.ry),
    "off by 90 degrees": lambda d: replace(d, ry=d.ry - math.pi / 2),
    "looks like degrees": lambda d: replace(d, ry=math.degrees(d.ry)),
    "centre of the box": lambda d: replace(d, location=(d.location[0], d.location[1] - d.size[0] / 2, d.location[2])),
    "top of the box": lambda d: replace(d, location=(d.location[0], d.location[1] - d.size[0], d.location[2])),
    "sizes are written l w h": lambda d: replace(d, size=(d.size[2], d.size[1], d.size[0])),
    "LiDAR frame": lidar_form,
    "lower than 25 px": lambda d: replace(d, bbox=(0, 0, 0, 0)),
    "carry no 3D box": lambda d: replace(d, size=(-1, -1, -1), location=(-1000, -1000, -1000)),
    "all scores are 1": lambda d: replace(d, score=1.0),
    "no detection is a Car": lambda d: replace(d, type="vehicle"),
}


@pytest.mark.parametrize("cause", SPOILT)
def test_a_spoilt_set_is_recognised(cause: str) -> None:
    labels = cars()
    spoilt = [[SPOILT[cause](replace(d, score=0.5 + i / 100)) for d in items] for i, items in enumerate(labels)]
    evaluation = prepare(labels, spoilt, classes=["Car"], metrics=["3d"], iou_set="strict")
    causes = likely_causes(evaluation.matcher, evaluation.targets[0])
    assert any(cause in text for text in causes), causes


def test_a_sound_set_has_no_cause() -> None:
    labels = cars()
    sound = [[replace(d, score=0.5 + i / 100) for d in items] for i, items in enumerate(labels)]
    evaluation = prepare(labels, sound, classes=["Car"], metrics=["3d"], iou_set="strict")
    assert likely_causes(evaluation.matcher, evaluation.targets[0]) == []


@pytest.mark.parametrize(
    ("labels", "detections", "words"),
    [
        ([[]], [[thing(score=1)]], "test split has no public labels"),
        ([[thing("Van")]], [[thing(score=1)]], r"no label is a Car; the labels hold Van \(1\)"),
        ([[thing(occluded=3)]], [[thing(score=1)]], "all 1 Car labels are ignored"),
        ([[thing()]], [[]], "every result file is empty"),
    ],
)
def test_nothing_to_find_is_recognised(labels: list, detections: list, words: str) -> None:
    evaluation = prepare(labels, detections, classes=["Car"], metrics=["3d"], iou_set="strict")
    causes = likely_causes(evaluation.matcher, evaluation.targets[0])
    assert len(causes) == 1
    assert re.search(words, causes[0])
