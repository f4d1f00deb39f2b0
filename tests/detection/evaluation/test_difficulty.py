"""KITTI's limits at their edges, and the thesis' Virtual KITTI 2 rule read several ways."""

from __future__ import annotations

import numpy as np
import pytest

from detection.evaluation.difficulty import (
    KittiDifficulty,
    Vkitti2Difficulty,
    difficulty_named,
    occlusion_from_fill,
)
from detection.evaluation.kitti_ap import evaluate
from tests.detection.evaluation.scenes import thing


def one(rule, height: float, truncation: float, occlusion: float) -> list[bool]:
    return rule.counts(np.array([height]), np.array([truncation]), np.array([occlusion]))[:, 0].tolist()


@pytest.mark.parametrize(
    ("height", "truncation", "occlusion", "cpp", "python"),
    [
        (40.0, 0.15, 0, [True, True, True], [False, True, True]),
        (39.99, 0.0, 0, [False, True, True], [False, True, True]),
        (25.0, 0.0, 0, [False, True, True], [False, False, False]),
        (24.99, 0.0, 0, [False, False, False], [False, False, False]),
        (60.0, 0.16, 0, [False, True, True], [False, True, True]),
        (60.0, 0.3, 1, [False, True, True], [False, True, True]),
        (60.0, 0.5, 2, [False, False, True], [False, False, True]),
        (60.0, 0.51, 0, [False, False, False], [False, False, False]),
        (60.0, 0.0, 3, [False, False, False], [False, False, False]),
    ],
)
def test_kitti_limits(height: float, truncation: float, occlusion: int, cpp: list, python: list) -> None:
    assert one(KittiDifficulty("cpp"), height, truncation, occlusion) == cpp
    assert one(KittiDifficulty("python"), height, truncation, occlusion) == python


@pytest.mark.parametrize(
    ("height", "truncation", "occlusion", "default", "literal_or", "literal_and"),
    [
        (50, 0.0, 0.0, 0, 0, 0),
        (40, 0.0, 0.0, 1, 3, 3),  # "greater than 40 pixels"; no sentence covers a clear object of 20 to 40 px
        (30, 0.2, 0.2, 1, 1, 1),
        (30, 0.2, 0.0, 1, 1, 3),  # one value below its band
        (50, 0.0, 0.6, 1, 1, 2),
        (50, 0.0, 0.7, 2, 2, 2),
        (18, 0.0, 0.0, 2, 3, 3),
        (50, 0.9, 0.0, 2, 2, 2),
        (50, 0.95, 0.0, 3, 3, 3),
        (50, 0.95, 0.8, 2, 2, 2),  # "or occlusion >= 0.6"
        (14, 0.0, 0.0, 3, 3, 3),
    ],
)
def test_vkitti2_levels(
    height: float, truncation: float, occlusion: float, default: int, literal_or: int, literal_and: int
) -> None:
    values = (np.array([height]), np.array([truncation]), np.array([occlusion]))
    assert Vkitti2Difficulty().level(*values)[0] == default
    assert Vkitti2Difficulty(leftover="ignore").level(*values)[0] == literal_or
    assert Vkitti2Difficulty(medium="and", leftover="ignore").level(*values)[0] == literal_and


def test_vkitti2_bands_and_cumulative_levels() -> None:
    assert one(Vkitti2Difficulty(), 50, 0, 0) == [True, True, True]
    assert one(Vkitti2Difficulty(nesting="bands"), 50, 0, 0) == [True, False, False]
    assert one(Vkitti2Difficulty(nesting="bands"), 30, 0.2, 0.2) == [False, True, False]


def test_vkitti2_counts_per_level_are_reported() -> None:
    labels = [[thing(), thing(x=5, height=30), thing(x=10, occluded=0.7), thing(x=-6, truncated=0.95)]]
    report = evaluate(labels, [[thing(score=0.5)]], classes=["Car"], metrics=["3d"], difficulty="vkitti2")
    assert report["protocol"]["objects_per_level"] == {"Car": {"easy": 1, "moderate": 1, "hard": 1, "none": 1}}
    assert report["results"][0]["n_gt"] == [1, 2, 3]


def test_vkitti2_ignores_detections_below_its_own_heights() -> None:
    assert Vkitti2Difficulty().min_height == (40.0, 20.0, 15.0)
    labels = [[thing(height=22)] for _ in range(41)]
    detections = [[thing(height=22, score=0.5)] for _ in range(41)]
    row = evaluate(labels, detections, classes=["Car"], metrics=["3d"], difficulty="vkitti2")["results"][0]
    assert (row["easy"], row["moderate"], row["hard"]) == (0, 100, 100)
    assert row["n_gt"] == [0, 41, 41]


def test_rules_by_name() -> None:
    assert difficulty_named("kitti", "python") == KittiDifficulty("python")
    assert difficulty_named("vkitti2:and:bands:ignore", "cpp") == Vkitti2Difficulty("and", "bands", "ignore")
    for wrong in ("kitti:and", "vkitti2:xor", "waymo"):
        with pytest.raises(ValueError, match="difficulty: expected"):
            difficulty_named(wrong, "cpp")
    with pytest.raises(ValueError, match="medium: expected or or and"):
        Vkitti2Difficulty(medium="xor")


def test_occlusion_from_the_fill_of_the_box() -> None:
    assert occlusion_from_fill(np.array([0.8, 0.4, 0.0, 0.9]), 0.8).tolist() == pytest.approx([0, 0.5, 1, 0])
    with pytest.raises(ValueError, match="full_fill"):
        occlusion_from_fill(np.array([0.5]), 0)
