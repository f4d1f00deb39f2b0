"""AP against the official values, the worked-out golden table, the plain Python twin, and its invariances."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detection.evaluation.difficulty import LEVELS
from detection.evaluation.kitti_ap import evaluate, prepare
from detection.kitti_format import KittiObject
from tests.detection.evaluation.scenes import dontcare, random_frames, thing
from tests.reference.kitti_ap_twin import average_precision

Frames = list[list[KittiObject]]
RANGES = {"all": (0, None), "0-30": (0, 30), "30-70": (30, 70)}


def as_found(item: KittiObject, score: float = 0.5, **changes) -> KittiObject:
    return replace(item, score=score, **changes)


def car_ap(labels: Frames, detections: Frames, **options) -> list[float | None]:
    rows = evaluate(labels, detections, classes=["Car"], metrics=["3d"], iou_set="strict", **options)["results"]
    return [rows[0][level] for level in LEVELS]


@pytest.mark.real_data
@pytest.mark.parametrize("recall", [40, 11])
@pytest.mark.parametrize(("reference", "flavor"), [("cpp", "cpp"), ("port", "python")])
@pytest.mark.parametrize("bounds", RANGES)
@pytest.mark.parametrize(("expected_set", "iou_set"), [("std", "strict"), ("loose", "loose")])
def test_equals_the_official_evaluator_and_the_port(
    ap_tiny: Path, reference: str, flavor: str, bounds: str, expected_set: str, iou_set: str, recall: int
) -> None:
    expected = json.loads((ap_tiny / "expected.json").read_text())[bounds][reference][expected_set]
    report = evaluate(
        ap_tiny / "label_2",
        ap_tiny / "detections",
        flavor=flavor,
        iou_set=iou_set,
        recall=recall,
        ranges=[RANGES[bounds]],
    )
    assert len(report["results"]) == 12
    for row in report["results"]:
        known = expected[row["class"]][{"2d": "bbox"}.get(row["metric"], row["metric"])][f"R{recall}"]
        assert [row[level] for level in LEVELS] == pytest.approx(known, abs=1e-4), row


@pytest.mark.parametrize(
    ("count", "found", "r11", "r40"),
    [
        (10, 10, 27.27, 22.5),
        (20, 20, 45.45, 47.5),
        (40, 40, 90.91, 97.5),
        (41, 41, 100, 100),
        (100, 100, 100, 100),
        (100, 80, 81.82, 80.0),
    ],
)
def test_golden_perfect_detections(count: int, found: int, r11: float, r40: float) -> None:
    labels = [[thing()] for _ in range(count)]
    detections = [[as_found(thing(), 1 - i / 1000)] if i < found else [] for i in range(count)]
    assert car_ap(labels, detections) == pytest.approx([r40] * 3, abs=0.005)
    assert car_ap(labels, detections, recall=11) == pytest.approx([r11] * 3, abs=0.005)


@pytest.mark.parametrize("recall", [40, 11])
def test_golden_height_at_the_limit_differs_between_the_references(recall: int) -> None:
    labels = [[thing(height=40)] for _ in range(60)]
    detections = [[as_found(items[0], 1 - i / 1000)] for i, items in enumerate(labels)]
    assert car_ap(labels, detections, recall=recall, flavor="cpp") == [100, 100, 100]
    assert car_ap(labels, detections, recall=recall, flavor="python") == [0, 100, 100]


@pytest.mark.parametrize("recall", [40, 11])
def test_golden_vans_absorb_cars(recall: int) -> None:
    labels = [[thing("Car" if i < 70 else "Van")] for i in range(100)]
    detections = [[as_found(items[0], 1 - i / 1000, type="Car")] for i, items in enumerate(labels)]
    assert car_ap(labels, detections, recall=recall) == [100, 100, 100]


def test_golden_logits_and_low_boxes() -> None:
    labels = [[thing()] for _ in range(100)]
    assert car_ap(labels, [[as_found(thing(), -5 - i / 10)] for i in range(100)]) == [100, 100, 100]
    low = [[as_found(thing(height=20), 1 - i / 1000)] for i in range(100)]
    assert car_ap(labels, low) == [0, 0, 0]


@pytest.mark.parametrize("flavor", ["cpp", "python"])
def test_labels_against_themselves_give_100(flavor: str) -> None:
    rng = np.random.default_rng(5)
    labels = [
        [
            thing(cls, x=-8 + 5 * k, ry=float(rng.uniform(-3, 3)))
            for k, cls in enumerate(("Car", "Pedestrian", "Cyclist"))
        ]
        for _ in range(45)
    ]
    detections = [[as_found(item, float(rng.random())) for item in items] for items in labels]
    for row in evaluate(labels, detections, flavor=flavor)["results"]:
        assert [row[level] for level in LEVELS] == pytest.approx([100, 100, 100], abs=1e-9), row
        assert row["n_gt"] == [45, 45, 45]


@pytest.mark.parametrize("flavor", ["cpp", "python"])
@pytest.mark.parametrize("seed", range(4))
def test_equals_the_twin_on_crowded_frames(seed: int, flavor: str) -> None:
    labels, detections = random_frames(seed, frames=40)
    recall = 40 if seed % 2 else 11
    compared = 0
    for row in evaluate(labels, detections, flavor=flavor, recall=recall)["results"]:
        for level, name in enumerate(LEVELS):
            setting = (row["class"], row["metric"], row["iou"], level)
            expected = average_precision(labels, detections, *setting, flavor=flavor, recall_points=recall)
            assert row[name] == pytest.approx(expected, abs=1e-9), (row, name)
            compared += expected > 0
    assert compared > 30, "the frames must be hard enough to say something"


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), flavor=st.sampled_from(["cpp", "python"]))
def test_equals_the_twin_on_any_small_set(seed: int, flavor: str) -> None:
    labels, detections = random_frames(seed, frames=6, crowd=4)
    for row in evaluate(labels, detections, flavor=flavor, iou_set="loose", classes=["Car"])["results"]:
        if row["moderate"] is None:
            continue
        setting = ("Car", row["metric"], row["iou"], 1)
        assert row["moderate"] == pytest.approx(average_precision(labels, detections, *setting, flavor=flavor))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_frame_order_names_case_and_scale_of_scores_do_not_matter(seed: int) -> None:
    labels, detections = random_frames(seed, frames=12)
    base = evaluate(labels, detections)["results"]
    order = np.random.default_rng(seed).permutation(len(labels))
    renamed = [f"frame{place:03d}" for place in range(len(labels))]
    shuffled = evaluate(
        {renamed[i]: labels[i] for i in order},
        {renamed[i]: [replace(d, type=d.type.upper()) for d in detections[i]] for i in order},
    )["results"]
    rescored = [[replace(d, score=math.exp(d.score) * 3 - 7) for d in items] for items in detections]
    for row, other, third in zip(base, shuffled, evaluate(labels, rescored)["results"]):
        for level in LEVELS:
            assert other[level] == pytest.approx(row[level], abs=1e-9)
            assert third[level] == pytest.approx(row[level], abs=1e-9)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), turns=st.integers(-3, 3))
def test_whole_turns_of_the_yaw_do_not_matter(seed: int, turns: int) -> None:
    labels, detections = random_frames(seed, frames=12)
    turned = [[replace(d, ry=d.ry + 2 * math.pi * turns) for d in items] for items in detections]
    for row, other in zip(evaluate(labels, detections)["results"], evaluate(labels, turned)["results"]):
        assert [other[level] for level in LEVELS] == pytest.approx([row[level] for level in LEVELS], abs=1e-9)


@settings(max_examples=30, deadline=None)
@given(data=st.data(), count=st.integers(2, 90))
def test_an_added_true_positive_never_lowers_ap(data: st.DataObject, count: int) -> None:
    scores = st.floats(-3, 3, allow_nan=False)
    hits = data.draw(st.lists(st.booleans(), min_size=count, max_size=count))
    missed = data.draw(st.integers(0, count - 1))
    hits[missed] = False
    labels = [[thing()] for _ in range(count)]
    detections = [[as_found(thing(), data.draw(scores))] if hit else [] for hit in hits]
    for _ in range(data.draw(st.integers(0, 20))):
        detections[data.draw(st.integers(0, count - 1))].append(as_found(thing(x=30), data.draw(scores)))
    detections[0].append(as_found(thing(x=40), -4.0))  # so that the class is always evaluated
    added = [list(items) for items in detections]
    added[missed].append(as_found(thing(), 3.5))
    before, after = car_ap(labels, detections), car_ap(labels, added)
    assert after[0] >= before[0] - 1e-9
    # The area under the whole curve grows wherever the new score falls; the 41 samples may trade one for another.
    added[missed][-1] = as_found(thing(), data.draw(scores))
    exact = [
        evaluate(labels, found, classes=["Car"], metrics=["3d"], iou_set="strict")["exact"][0]["easy"]
        for found in (detections, added)
    ]
    assert exact[1] >= exact[0] - 1e-9


def test_exact_ap_is_the_area_under_the_whole_curve() -> None:
    # Hit (0.9), miss (0.8), hit (0.7) of 4 labels: recall 1/4 at precision 1, then recall 2/4 at precision 2/3.
    labels = [[thing()] for _ in range(4)]
    detections = [[as_found(thing(), 0.9), as_found(thing(x=30), 0.8)], [as_found(thing(), 0.7)], [], []]
    report = evaluate(labels, detections, classes=["Car"], metrics=["3d"], iou_set="strict")
    assert report["exact"][0]["easy"] == pytest.approx(100 * (1 / 4 + 2 / 3 / 4))
    assert report["recall"][0]["easy"] == pytest.approx(50)
    # Two samples only: recall 0 (left out of R40) and the next one, at precision 2/3.
    assert report["results"][0]["easy"] == pytest.approx(100 * 2 / 3 / 40)


def test_a_set_of_fewer_than_41_objects_is_announced() -> None:
    labels = [[thing()] for _ in range(10)]
    report = evaluate(labels, [[as_found(thing(), 0.5)] for _ in range(10)], classes=["Car"])
    assert any("Car easy: only 10 objects" in text and "22.5" in text for text in report["warnings"])
    labels = [[thing()] for _ in range(41)]
    report = evaluate(labels, [[as_found(thing(), 0.5)] for _ in range(41)], classes=["Car"])
    assert report["warnings"] == []


def test_a_class_without_detections_has_no_ap() -> None:
    report = evaluate([[thing(), thing("Cyclist", x=5)]], [[as_found(thing())]], classes=["Car", "Cyclist"])
    values = {row["class"]: row["moderate"] for row in report["results"]}
    assert values == {"Car": 0.0, "Cyclist": None}
    assert all(row["n_gt"] == [1, 1, 1] for row in report["results"])


def test_the_devkit_asks_for_a_box_per_metric() -> None:
    flat = as_found(thing(), size=(-1, -1, -1), location=(-1000, -1000, -1000))
    found = {
        flavor: {
            row["metric"]: row["moderate"] for row in evaluate([[thing()]], [[flat]], flavor=flavor)["results"][:4]
        }
        for flavor in ("cpp", "python")
    }
    assert found["cpp"] == {"2d": 0.0, "aos": 0.0, "bev": None, "3d": None}
    assert found["python"] == {"2d": 0.0, "aos": 0.0, "bev": 0.0, "3d": 0.0}


def test_one_invalid_alpha_ends_aos_in_the_devkit_and_only_as_the_first_in_the_port() -> None:
    labels = [[thing(), thing(x=8)] for _ in range(50)]
    detections = [[as_found(a, 0.9), as_found(b, 0.8)] for a, b in labels]
    detections[7][1] = replace(detections[7][1], alpha=-10.0)
    aos = {
        flavor: evaluate(labels, detections, flavor=flavor, metrics=["aos"])["results"][0]["easy"]
        for flavor in ("cpp", "python")
    }
    assert aos["cpp"] is None
    assert aos["python"] == pytest.approx(100, abs=3)
    detections[0][0] = replace(detections[0][0], alpha=-10.0)
    assert evaluate(labels, detections, flavor="python", metrics=["aos"])["results"][0]["easy"] is None


def test_aos_is_scaled_by_the_cosine() -> None:
    labels = [[thing()] for _ in range(50)]
    turned = [[as_found(thing(), 0.5, alpha=0.3 + math.radians(60))] for _ in range(50)]
    row = evaluate(labels, turned, classes=["Car"], metrics=["aos"])["results"][0]
    assert row["easy"] == pytest.approx(75)  # (1 + cos 60) / 2


def test_dontcare_absorbs_in_the_image_only() -> None:
    labels = [[thing(), dontcare((0, 100, 200, 300))] for _ in range(41)]
    stray = as_found(thing(x=30), 0.9, bbox=(20.0, 120.0, 100.0, 220.0))
    detections = [[as_found(thing(), 0.5), stray] for _ in range(41)]
    values = {
        row["metric"]: row["easy"] for row in evaluate(labels, detections, classes=["Car"], iou_set="strict")["results"]
    }
    assert values["2d"] == 100
    assert values["3d"] == values["bev"] == pytest.approx(50)


@pytest.mark.parametrize(("flavor", "absorbed"), [("cpp", True), ("python", False)])
def test_dontcare_in_another_case_counts_for_the_devkit_only(flavor: str, absorbed: bool) -> None:
    area = replace(dontcare((0, 100, 200, 300)), type="dontcare")
    stray = as_found(thing(x=30), 0.9, bbox=(20.0, 120.0, 100.0, 220.0))
    labels, detections = [[thing(), area]] * 41, [[as_found(thing(), 0.5), stray]] * 41
    row = evaluate(labels, detections, classes=["Car"], metrics=["2d"], flavor=flavor)["results"][0]
    assert row["easy"] == pytest.approx(100 if absorbed else 50)


def test_overlap_exactly_at_the_limit_does_not_match() -> None:
    # A box half as wide inside the other has an IoU of exactly 1/2.
    label = thing("Pedestrian", bbox=(100.0, 100.0, 200.0, 200.0))
    half = as_found(label, 0.5, bbox=(100.0, 100.0, 150.0, 200.0))
    report = evaluate(
        [[label]] * 50, [[half]] * 50, classes=["Pedestrian"], metrics=["2d"], ious={"Pedestrian": [0.5, 0.49]}
    )
    assert [row["easy"] for row in report["results"]] == [0, 100]


def test_equal_scores_and_lower_case_types_are_taken() -> None:
    labels = [[thing()] for _ in range(60)]
    detections = [[as_found(thing(), 1.0, type="car"), as_found(thing(x=30), 1.0)] for _ in range(60)]
    assert car_ap(labels, detections) == pytest.approx([50, 50, 50])


def test_range_bounds_belong_to_the_upper_bin() -> None:
    labels = [[thing(z=29.99), thing(x=8, z=30.0)] for _ in range(2)]
    detections = [[as_found(item) for item in items] for items in labels]
    rows = evaluate(
        labels, detections, classes=["Car"], metrics=["3d"], iou_set="strict", ranges=[(0, 30), (30, 70), (0, None)]
    )
    assert [row["n_gt"][0] for row in rows["results"]] == [2, 2, 4]
    assert [row["range"] for row in rows["results"]] == [[0, 30], [30, 70], [0, None]]


@pytest.mark.parametrize("flavor", ["cpp", "python"])
@pytest.mark.parametrize("bounds", [(0, 14), (12, 16)])
def test_a_range_equals_files_filtered_beforehand(bounds: tuple[float, float], flavor: str) -> None:
    labels, detections = random_frames(21, frames=40)
    inside = [[bounds[0] <= d.location[2] < bounds[1] for d in items] for items in detections]
    kept = [[d for d, keep in zip(items, row) if keep] for items, row in zip(detections, inside)]
    # Occlusion 3 is beyond every level: such a label is ignored, while neighbours and areas stay what they are.
    hidden = [
        [g if g.type == "DontCare" or bounds[0] <= g.location[2] < bounds[1] else replace(g, occluded=3) for g in items]
        for items in labels
    ]
    filtered = evaluate(hidden, kept, flavor=flavor)["results"]
    compared = 0
    for row, other in zip(evaluate(labels, detections, flavor=flavor, ranges=[bounds])["results"], filtered):
        assert [row[level] for level in LEVELS] == [other[level] for level in LEVELS]
        assert row["n_gt"] == other["n_gt"]
        compared += row["hard"] is not None and row["hard"] > 0
    assert compared > 8


def test_range_rules_differ_for_a_detection_across_the_border() -> None:
    labels = [[thing(z=29.9)] for _ in range(50)]
    across = [[as_found(thing(z=30.1), 0.5), as_found(thing(x=9, z=40), 0.9)] for _ in range(50)]
    assert car_ap(labels, across, ranges=[(0, 30)], range_rule="clocs") == [None, None, None]
    assert car_ap(labels, across, ranges=[(0, 30)], range_rule="border") == [100, 100, 100]
    # Near enough to a label outside that is ignored, a detection inside is no false positive.
    labels = [[thing(), thing(x=9, z=30.1)] for _ in range(50)]
    detections = [[as_found(thing(), 0.5), as_found(thing(x=9, z=29.9), 0.9)] for _ in range(50)]
    assert car_ap(labels, detections, ranges=[(0, 30)]) == [100, 100, 100]


def test_range_can_be_the_distance_on_the_ground() -> None:
    labels = [[thing(x=20, z=25)] for _ in range(50)]
    detections = [[as_found(items[0])] for items in labels]
    assert car_ap(labels, detections, ranges=[(0, 30)], range_axis="z") == [100, 100, 100]
    assert car_ap(labels, detections, ranges=[(0, 30)], range_axis="radius") == [None, None, None]


def test_any_class_and_the_order_of_rows() -> None:
    labels = [[thing("Truck"), thing("Tram", x=12)] for _ in range(41)]
    detections = [[as_found(item, type=item.type) for item in items] for items in labels]
    report = evaluate(labels, detections, classes=["Tram", "Truck"], metrics=["3d", "2d"], iou_set="both")
    assert [(row["class"], row["metric"], row["iou"]) for row in report["results"]] == [
        ("Tram", "3d", 0.5),
        ("Tram", "2d", 0.5),
        ("Tram", "3d", 0.25),
        ("Truck", "3d", 0.5),
        ("Truck", "2d", 0.5),
        ("Truck", "3d", 0.25),
    ]
    assert all(row["hard"] == 100 for row in report["results"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"classes": "Car"}, "list of class names"),
        ({"classes": ["DontCare"]}, "DontCare"),
        ({"iou_set": "medium"}, "strict, loose, both"),
        ({"metrics": ["4d"]}, "4d"),
        ({"ious": {"Car": [1.2]}}, "IoU of Car"),
        ({"ious": {"Tram": [0.5]}}, "not evaluated"),
        ({"ranges": [(30, 10)]}, "LO < HI"),
        ({"recall": 41}, "40 or 11"),
        ({"flavor": "matlab"}, "cpp or python"),
        ({"range_rule": "none"}, "clocs or border"),
        ({"difficulty": "nuscenes"}, "vkitti2"),
        ({"missing": "maybe"}, "missing"),
    ],
)
def test_an_impossible_request_says_what_is_expected(options: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        evaluate([[thing()]], [[as_found(thing())]], **options)


def test_the_sampled_curve_by_hand() -> None:
    # 3 labels, hits at 0.9 and 0.6, a false positive at 0.7: thresholds 0.9 and 0.6.
    labels = [[thing()] for _ in range(3)]
    detections = [[as_found(thing(), 0.9)], [as_found(thing(), 0.6), as_found(thing(x=30), 0.7)], []]
    evaluation = prepare(labels, detections, classes=["Car"], metrics=["3d"], iou_set="strict")
    curve = evaluation.curves(evaluation.targets[0])[0]
    assert curve.thresholds.tolist() == [0.9, 0.6]
    assert (curve.tp.tolist(), curve.fp.tolist()) == ([1, 2], [0, 1])
    assert curve.precision()[:3].tolist() == pytest.approx([1, 2 / 3, 0])
    assert curve.recall.tolist() == pytest.approx([1 / 3, 2 / 3])


def test_importing_the_evaluator_needs_numpy_and_numba_only() -> None:
    def packages(statement: str) -> set[str]:
        code = f"import sys; {statement}; print(' '.join(sys.modules))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        return {name.split(".")[0] for name in done.stdout.split()} - set(sys.stdlib_module_names)

    # numba looks for scipy and yaml by itself where they are installed.
    added = packages("from detection.evaluation.kitti_ap import evaluate") - packages("import numba, numpy")
    assert added <= {"detection", "auglidar_base", "__mp_main__"}
