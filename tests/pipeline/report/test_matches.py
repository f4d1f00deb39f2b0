"""Mistakes, confidence intervals, curves, choice of frames and comparison of runs."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from detection.evaluation.kitti_ap import prepare
from detection.kitti_format import KittiObject
from pipeline.base.errors import UsageError
from pipeline.base.paths import RunFolder
from pipeline.report.boxes import drawn_boxes
from pipeline.report.matches import (
    MatchedFrames,
    Mistake,
    ap_cells,
    curve_panels,
    difference_rows,
    mistakes,
    verdict_text,
    verdicts,
)
from pipeline.report.page import chosen_frames
from tests.pipeline.report.scored import score_and_report, write_run
from tests.pipeline.tiny_kitti import CALIBRATION


def car(x: float, z: float, score: float | None = None) -> KittiObject:
    return KittiObject("Car", 0.0, 0, 0.0, (100 + x, 100, 200 + x, 160), (1.5, 1.6, 4.0), (x, 1.6, z), 0.0, score)


def matched(labels: dict[str, list[KittiObject]], detections: dict[str, list[KittiObject]]) -> MatchedFrames:
    evaluation = prepare(labels, detections, classes=("Car",), iou_set="strict")
    return MatchedFrames(labels, detections, evaluation, verdicts(evaluation))


@pytest.fixture
def example() -> MatchedFrames:
    """Frame a: one found, one missed at 10 m, one false; frame b: one missed at 30 m, one sure false."""
    return matched(
        {"a": [car(0, 20), car(8, 10)], "b": [car(0, 30)]},
        {"a": [car(0, 20, 0.9), car(-20, 25, 0.2)], "b": [car(-15, 40, 0.8)]},
    )


def test_mistakes_come_worst_first_with_their_reason(example: MatchedFrames) -> None:
    found = mistakes(example)
    # Weights: missed 100 - 10 and 100 - 30; false by the rank of the score among three: 2/3 and 1/3.
    assert [(item.frame, item.kind, round(item.weight, 1)) for item in found] == [
        ("a", "missed", 90.0),
        ("b", "missed", 70.0),
        ("b", "false", 66.7),
        ("a", "false", 33.3),
    ]
    assert found[0].reason == "no detection overlaps"
    assert found[2].reason == "nothing there"


def test_a_detection_in_a_dontcare_area_says_so(example: MatchedFrames) -> None:
    """3D matching knows no DontCare areas: the detection is wrong there, but not for want of anything in the image."""
    area = KittiObject("DontCare", -1, -1, -10, (70, 90, 190, 170), (-1, -1, -1), (-1000, -1000, -1000), -10)
    found = matched({"a": [car(0, 20), area]}, {"a": [car(0, 20, 0.9), car(-20, 25, 0.2)]})
    verdict = found.verdicts["a", "detection", 1]
    assert (verdict.status, verdict.reason) == ("false positive", "in a DontCare area")
    assert "counts all the same" in verdict_text(verdict)


def test_verdicts_name_the_place_in_the_list(example: MatchedFrames) -> None:
    assert example.verdicts["a", "label", 0].status == "matched"
    assert verdict_text(example.verdicts["a", "label", 1]) == "missed: no detection overlaps"
    assert verdict_text(None) == ""


def test_a_found_label_knows_the_score_that_found_it(example: MatchedFrames) -> None:
    verdicts_of_a = {place: verdict for (frame, side, place), verdict in example.verdicts.items()
                     if (frame, side) == ("a", "label")}  # fmt: skip
    boxes = drawn_boxes(example.labels["a"], CALIBRATION, (400, 960), verdicts_of_a, example.detections["a"])
    assert [box.met for box in boxes] == [0.9, None]
    assert [box.wrong for box in boxes] == [False, True]
    assert example.verdicts["a", "detection", 0].partner == 1
    assert example.verdicts["a", "detection", 1].partner == 0


def test_ap_comes_with_its_interval(example: MatchedFrames) -> None:
    cells = {row[1]: row for row in ap_cells(example)}
    assert set(cells) == {"2D box", "orientation", "bird's eye", "3D box"}
    value = re.fullmatch(r"([\d.]+) \[(\d+)–(\d+)\]", cells["3D box"][3])
    assert value is not None
    assert float(value[2]) - 0.5 <= float(value[1]) <= float(value[3]) + 0.5
    assert ap_cells(MatchedFrames()) == []


def test_curves_reach_as_far_as_the_recall(example: MatchedFrames) -> None:
    panel = curve_panels(example)[0]
    assert panel.title == "Car, 3D box, IoU 0.7"
    numbers = [float(text) for text in re.findall(r"-?[\d.]+", dict(panel.paths)["easy"])]
    assert len(numbers) == 82
    assert numbers[:2] == [0.0, 0.0]  # recall 0, precision 100 %: the surest detection is right
    assert numbers[-2:] == [100.0, 100.0]  # recall 100 % is never reached


def test_a_run_differs_from_another_by_its_ap(example: MatchedFrames) -> None:
    better = matched(example.labels, {"a": [car(0, 20, 0.9), car(8, 10, 0.8)], "b": [car(0, 30, 0.7)]})
    rows = difference_rows(better, example)
    assert {row[1] for row in rows} == {"3D box", "bird's eye"}
    for row in rows:
        assert float(row[4]) > float(row[5])
        assert row[6].startswith(f"{float(row[4]) - float(row[5]):+.1f}")
    assert difference_rows(better, MatchedFrames()) == []


def test_shown_frames_are_the_worst_and_some_others() -> None:
    frames = tuple("abcdefgh")
    found = [Mistake(name, "missed", car(0, 10), "", 1.0) for name in "fgfh"]
    assert chosen_frames(frames, found, 4) == ("a", "f", "g", "h")
    assert chosen_frames(frames, found, 8) == frames
    assert chosen_frames(frames, [], 2) == ("a", "h")


def test_two_runs_stand_side_by_side(run: RunFolder, tmp_path: Path) -> None:
    other = write_run(tmp_path, "other", 3.0)
    score_and_report(other)
    text = score_and_report(run, f"report.compare={other.root}")
    assert text.count('class="box other"') == 6
    assert re.search(r"<td>mean error \(MAE\), mm</td><td>1,000</td><td>3,000</td>", text)
    assert text.count("<h4>other</h4>") == 3


def test_a_run_to_compare_with_must_be_there(run: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"report.compare: .*nowhere is not a folder of a run"):
        score_and_report(run, f"report.compare={tmp_path / 'nowhere'}")


def test_a_missed_object_is_listed_with_its_picture(run: RunFolder) -> None:
    label = run.root.parent / "kitti" / "training" / "label_2" / "000001.txt"
    lines = [replace(car(0, 12), bbox=(20.0, 2.0, 70.0, 44.0))]
    from detection.kitti_format import format_line

    label.write_text("".join(format_line(item) + "\n" for item in lines))
    run.detections("000001").write_text("")
    text = score_and_report(run)
    assert "<b>Car, 12\u00a0m</b><small>frame 000001</small><span>no detection overlaps</span>" in text
    assert 'href=#frame-2 class="mistake missed"' in text
