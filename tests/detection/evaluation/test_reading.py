"""Folders as tables: every kind of damage has a message with file and line, or is counted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from detection.evaluation.diagnose import likely_causes
from detection.evaluation.kitti_ap import evaluate, prepare
from detection.evaluation.reading import InputError, read_pair, read_split
from detection.kitti_format import format_line
from tests.detection.evaluation.scenes import thing

LABEL = format_line(thing())
FOUND = format_line(thing(score=0.5))


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Three frames, one car each, all found."""
    for name, line in (("label_2", LABEL), ("detections", FOUND)):
        (tmp_path / name).mkdir()
        for frame in range(3):
            (tmp_path / name / f"{frame:06d}.txt").write_text(f"{line}\n")
    return tmp_path / "label_2", tmp_path / "detections"


def test_reads_what_was_written(folders: tuple[Path, Path]) -> None:
    (folders[0] / "000001.txt").write_text("")
    (folders[1] / "000002.txt").write_text(f"{FOUND}\r\n\n{FOUND.replace('Car', 'Van')}")
    pair = read_pair(*folders)
    assert pair.frames == ("000000", "000001", "000002")
    assert pair.labels.offsets.tolist() == [0, 1, 1, 2]
    assert pair.detections.types == ("Car", "Van")
    assert pair.detections.line.tolist() == [1, 1, 1, 3]
    item = thing(score=0.5)
    assert pair.detections.boxes_3d[0].tolist() == pytest.approx([*item.location, *item.size, item.ry])
    assert pair.detections.boxes_2d[0].tolist() == pytest.approx(item.bbox)
    assert pair.detections.score.tolist() == [0.5] * 4
    assert np.isnan(pair.labels.score).all()


def test_fractional_truncation_and_occlusion_are_kept(folders: tuple[Path, Path]) -> None:
    (folders[0] / "000000.txt").write_text(LABEL.replace("Car 0.00 0", "Car 0.37 0.61"))
    pair = read_pair(*folders)
    assert pair.labels.values[0, :2].tolist() == [0.37, 0.61]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (" ".join(FOUND.split()[:-1]), r"000001\.txt:2: expected 16 columns, got 15; a result line needs a score"),
        (FOUND.replace("1.6000", "1,6"), r"000001\.txt:2: column '\w+' is not a number: '1,6'"),
        (FOUND.replace("0.500000", "nan"), r"000001\.txt:2: column 'score' is nan"),
        (FOUND.replace("20.0000", "inf"), r"000001\.txt:2: column 'z' is inf"),
        ("Car", r"000001\.txt:2: expected 16 columns, got 1"),
    ],
)
def test_a_broken_line_is_named_or_counted(folders: tuple[Path, Path], line: str, words: str) -> None:
    (folders[1] / "000001.txt").write_text(f"{FOUND}\n{line}\n")
    with pytest.raises(InputError, match=words):
        evaluate(*folders)
    report = evaluate(*folders, lenient=True)
    assert report["skipped"] == {"broken line": 1}
    assert report["protocol"]["detections"] == 3
    assert any("000001.txt:2" in text for text in report["warnings"])


def test_a_broken_label_is_named(folders: tuple[Path, Path]) -> None:
    (folders[0] / "000002.txt").write_text(LABEL.rsplit(" ", 1)[0])
    with pytest.raises(InputError, match=r"label_2.000002\.txt:1: expected 15 columns, got 14"):
        evaluate(*folders)


@pytest.mark.parametrize("columns", [16, 17, 18])
def test_columns_that_the_devkit_does_not_read_are_not_read(folders: tuple[Path, Path], columns: int) -> None:
    expected = evaluate(*folders)
    for folder, width in zip(folders, (15, 16)):
        for path in folder.glob("*.txt"):
            path.write_text("\n".join(line + " 0" * (columns - width) for line in path.read_text().splitlines()))
    report = evaluate(*folders)
    assert report["results"] == expected["results"]
    notes = [text for text in report["warnings"] if "columns" in text]
    assert len(notes) == (1 if columns == 16 else 2)
    assert f"lines have {columns} columns; the first 15 are read" in notes[0]
    assert evaluate(*folders, lenient=True)["results"] == expected["results"]


def test_labels_of_which_no_line_can_be_read_are_not_called_empty(folders: tuple[Path, Path]) -> None:
    for path in folders[0].iterdir():
        path.write_text("Car 0 0\n")
    with pytest.raises(InputError, match=r"label_2: none of 3 lines can be read; the first: .*got 3"):
        evaluate(*folders, lenient=True)


def test_a_missing_file_is_named_skipped_or_empty(folders: tuple[Path, Path]) -> None:
    (folders[1] / "000001.txt").unlink()
    with pytest.raises(InputError, match=r"no result file for frame 000001 \(1 of 3 frames\).*empty file"):
        evaluate(*folders)
    assert read_pair(*folders, missing="skip").frames == ("000000", "000002")
    report = evaluate(*folders, missing="empty", classes=["Car"])
    assert report["results"][0]["n_gt"] == [3, 3, 3]
    assert report["skipped"] == {}
    report = evaluate(*folders, lenient=True)
    assert report["skipped"] == {"missing result file": 1}
    assert report["protocol"]["frames"] == 3


def test_a_result_of_an_unknown_frame_is_named_or_counted(folders: tuple[Path, Path]) -> None:
    (folders[1] / "000099.txt").write_text(FOUND)
    with pytest.raises(InputError, match="result for unknown frame 000099"):
        evaluate(*folders)
    assert evaluate(*folders, lenient=True)["skipped"] == {"result of unknown frame": 1}


def test_a_split_selects_and_orders(folders: tuple[Path, Path], tmp_path: Path) -> None:
    split = tmp_path / "val.txt"
    split.write_text("000002\n000000\n")
    pair = read_pair(*folders, frames=read_split(split))
    assert pair.frames == ("000002", "000000")
    with pytest.raises(InputError, match="no label file for frame 000007"):
        read_pair(*folders, frames=["000000", "000007"])
    split.write_text("000000\n000000\n")
    with pytest.raises(InputError, match="listed twice"):
        read_split(split)
    split.write_text("\n")
    with pytest.raises(InputError, match="empty"):
        read_split(split)
    with pytest.raises(InputError, match="no_such"):
        read_split(tmp_path / "no_such.txt")


def test_folders_that_cannot_be_evaluated_say_why(folders: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        evaluate(tmp_path / "nowhere", folders[1])
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match="test split has no public labels"):
        evaluate(tmp_path / "none", folders[1])
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "7.txt").write_text(FOUND)
    with pytest.raises(InputError, match="no frame in common: labels are named 000000 to 000002, detections 7 to 7"):
        evaluate(folders[0], tmp_path / "other")


def test_the_devkit_layout_with_a_data_folder_is_found(folders: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "results").mkdir()
    folders[1].rename(tmp_path / "results" / "data")
    assert read_pair(folders[0], tmp_path / "results").detections.score.tolist() == [0.5] * 3


def test_objects_in_memory_are_checked() -> None:
    with pytest.raises(ValueError, match="000001:1: expected a detection with a score"):
        evaluate([[thing()], [thing()]], [[thing(score=0.5)], [thing()]])
    with pytest.raises(ValueError, match="000000:1: NaN"):
        evaluate([[thing()]], [[replace(thing(score=0.5), score=float("nan"))]])


def test_memory_and_folders_give_the_same(folders: tuple[Path, Path]) -> None:
    names = ["000000", "000001", "000002"]
    memory = evaluate({name: [thing()] for name in names}, {name: [thing(score=0.5)] for name in names})
    assert memory == evaluate(*folders)


def test_many_broken_lines_are_summed_up_and_named_as_the_cause(folders: tuple[Path, Path]) -> None:
    for path in folders[1].iterdir():
        path.write_text(LABEL + "\n" + LABEL)
    evaluation = prepare(*folders, lenient=True, classes=["Car"])
    report = evaluation.report()
    assert report["skipped"] == {"broken line": 6}
    assert report["warnings"][-1] == "broken line: 3 more were passed over"
    assert sum("needs a score" in text for text in report["warnings"]) == 3
    causes = likely_causes(evaluation.matcher, evaluation.targets[0])
    assert len(causes) == 1
    assert "no line of the result files could be used (6 broken)" in causes[0]
    assert "needs a score in column 16" in causes[0]
