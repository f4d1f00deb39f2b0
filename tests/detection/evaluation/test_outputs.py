"""Tables, curves as CSV and pictures, and the submission archive."""

from __future__ import annotations

import csv
import zipfile
from pathlib import Path

import pytest

from detection.evaluation.bootstrap import Resampling, confidence_intervals, paired_differences
from detection.evaluation.kitti_ap import evaluate, prepare
from detection.evaluation.plots import score_histogram, write_curves
from detection.evaluation.submission import check_submission, write_archive
from detection.evaluation.tables import difference_table, interval_table, latex_table, markdown_table
from detection.kitti_format import format_line
from tests.detection.evaluation.scenes import random_frames, thing

LABELS = [[thing()] for _ in range(50)]
FOUND = [[thing(score=0.5 + i / 100)] if i < 40 else [thing(x=30, score=0.1)] for i in range(50)]


def test_markdown_row() -> None:
    report = evaluate(LABELS, FOUND, classes=["Car"], metrics=["3d", "aos"], iou_set="strict", ranges=[(0, 30)])
    lines = markdown_table(report).splitlines()
    assert lines[0].count("|") == lines[1].count("|") == lines[2].count("|")
    triple = "80.0 / 80.0 / 80.0"
    assert lines[2] == f"| Car | 3D R40 | 0.7 | 0-30 m | 80.00 | 80.00 | 80.00 | {triple} | {triple} | 50 / 50 / 50 |"
    assert "| AOS R40 |" in lines[3]
    assert lines[3].endswith("| - | - | 50 / 50 / 50 |")


def test_latex_rows_and_missing_values() -> None:
    rows = evaluate(LABELS, FOUND, classes=["Car", "Person_sitting"], metrics=["3d"], iou_set="strict")["results"]
    text = latex_table(rows)
    assert r"Car & 3D $R_{40}$ & 0.7 & all & 80.00 & 80.00 & 80.00 \\" in text
    assert r"Person\_sitting & 3D $R_{40}$ & 0.5 & all & - & - & - \\" in text
    assert text.count(r"\midrule") == 2
    assert text.startswith(r"\begin{tabular}")
    assert text.endswith("\\end{tabular}\n")


def test_interval_and_difference_tables() -> None:
    poor = prepare(LABELS, FOUND, classes=["Car"], metrics=["3d"], iou_set="strict")
    good = prepare(LABELS, [[thing(score=1.0)]] * 50, classes=["Car"], metrics=["3d"], iou_set="strict")
    resampling = Resampling(50, 0, 0.9)
    table = interval_table(confidence_intervals(good, resampling), 0.9)
    assert table.startswith("AP with 90 % bootstrap intervals")
    assert "| Car | 3D | 0.7 | all | 100.00 [100.00, 100.00] |" in table
    table = difference_table(paired_differences({"poor": poor, "good": good}, resampling), 0.9)
    assert "| easy | good - poor | 100.00 | +20.00 | [+" in table
    assert "] * | 100 % |" in table


def test_curves_csv_holds_the_samples_of_the_result(tmp_path: Path) -> None:
    evaluation = prepare(LABELS, FOUND, classes=["Car"], iou_set="both")
    written = write_curves(evaluation, tmp_path / "curves")
    assert sorted(path.name for path in written) == ["curves.csv", "curves_Car.png", "scores.csv", "scores_Car.png"]
    assert all(path.stat().st_size > 0 for path in written)
    assert (tmp_path / "curves" / "curves_Car.png").read_bytes().startswith(b"\x89PNG")
    with open(written[0], newline="") as file:
        rows = [
            row for row in csv.DictReader(file) if (row["metric"], row["iou"], row["level"]) == ("3d", "0.7", "easy")
        ]
    assert len(rows) == 41
    ap = 100 * sum(float(row["interpolated"]) for row in rows[1:]) / 40
    assert ap == pytest.approx(80, abs=1e-3)
    assert (rows[0]["tp"], rows[0]["fp"]) == ("1", "0")
    assert rows[40]["score_threshold"] == ""


def test_score_histogram_counts_every_detection_of_the_class() -> None:
    labels, detections = random_frames(6, 30)
    evaluation = prepare(labels, detections, classes=["Car"], metrics=["3d"], iou_set="strict")
    edges, groups = score_histogram(evaluation.matcher, evaluation.targets[0], level=1)
    assert len(edges) == 21
    assert sum(counts.sum() for counts in groups.values()) == sum(
        d.type.lower() == "car" for f in detections for d in f
    )
    records = evaluation.records[evaluation.targets[0]][1]
    assert groups["true positive"].sum() == records.tp.sum()
    assert groups["false positive"].sum() == records.fp.sum()


@pytest.fixture
def results(tmp_path: Path) -> Path:
    folder = tmp_path / "results"
    folder.mkdir()
    for frame in range(4):
        (folder / f"{frame:06d}.txt").write_text(format_line(thing(score=0.1 * frame)) + "\n" if frame != 2 else "")
    return folder


def test_a_sound_submission_is_packed_at_the_root_and_reproducibly(results: Path, tmp_path: Path) -> None:
    assert check_submission(results, 4) == ([], [])
    first = write_archive(results, tmp_path / "a.zip", 4)
    second = write_archive(results, tmp_path / "b.zip", 4)
    assert first.read_bytes() == second.read_bytes()
    with zipfile.ZipFile(first) as packed:
        assert packed.namelist() == [f"{frame:06d}.txt" for frame in range(4)]
        assert packed.read("000002.txt") == b""
        assert packed.read("000001.txt") == (results / "000001.txt").read_bytes()


def test_missing_files_can_be_filled(results: Path, tmp_path: Path) -> None:
    errors, _ = check_submission(results, 6)
    assert "2 of 6 result files are missing, first 000004.txt" in errors[0]
    assert check_submission(results, 6, fill=True)[0] == []
    with zipfile.ZipFile(write_archive(results, tmp_path / "a.zip", 6)) as packed:
        assert len(packed.namelist()) == 6
        assert packed.read("000005.txt") == b""


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("000001.txt", format_line(thing()), "000001.txt:1: expected 16 columns, got 15"),
        ("000001.txt", format_line(thing("Bus", score=1)), "unknown type 'Bus'"),
        ("000001.txt", format_line(thing(score=1, bbox=(10, 10, 5, 50))), "000001.txt:1: 2D box has x2 < x1"),
        ("000001.txt", "Car nonsense", "000001.txt:1"),
        ("007518.txt", "", "not of the split, first 007518.txt"),
    ],
)
def test_what_the_server_refuses_is_found_first(results: Path, name: str, text: str, words: str) -> None:
    (results / name).write_text(text + "\n")
    errors, _ = check_submission(results, 4)
    assert any(words in message for message in errors), errors


def test_legal_but_unwanted_results_are_announced(results: Path) -> None:
    (results / "000000.txt").write_text(format_line(thing(score=1, alpha=-10, height=20)) + "\n")
    errors, warnings = check_submission(results, 4)
    assert errors == []
    assert any("alpha -10" in text for text in warnings)
    assert any("lower than 25 px" in text for text in warnings)
    for frame in range(4):
        (results / f"{frame:06d}.txt").write_text(format_line(thing(score=1)) + "\n")
    assert any("all scores are equal" in text for text in check_submission(results, 4)[1])


def test_nothing_detected_or_no_folder_is_refused(results: Path, tmp_path: Path) -> None:
    for frame in range(4):
        (results / f"{frame:06d}.txt").write_text("")
    assert "nothing to evaluate" in check_submission(results, 4)[0][0]
    assert "no such folder" in check_submission(tmp_path / "nowhere", 4)[0][0]
