"""`--stage evaluate` as a user meets it: arguments in, table, JSON, messages and exit code out."""

from __future__ import annotations

import argparse
import json
from dataclasses import fields, replace
from pathlib import Path

import pytest

from detection.evaluation.kitti_ap import evaluate
from detection.evaluation.protocol import EvaluationProtocol
from detection.kitti_format import format_line
from pipeline.base.settings import plain
from pipeline.run_folder.config import load_config
from pipeline.verbs.evaluate import add_arguments, protocol_of, run
from tests.detection.evaluation.scenes import random_frames, thing


def call(*arguments: str | Path) -> int:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return run(parser.parse_args([str(argument) for argument in arguments]))


def write(folder: Path, frames: list) -> Path:
    folder.mkdir()
    for index, items in enumerate(frames):
        (folder / f"{index:06d}.txt").write_text("".join(format_line(item) + "\n" for item in items))
    return folder


@pytest.fixture
def folders(tmp_path: Path) -> tuple[str, ...]:
    labels, detections = random_frames(9, 30)
    return (
        *("--labels", str(write(tmp_path / "labels", labels))),
        *("--detections", str(write(tmp_path / "ours", detections))),
    )


def test_json_equals_the_library(folders: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(*folders, "--json", tmp_path / "out" / "ap.json") == 0
    stored = json.loads((tmp_path / "out" / "ap.json").read_text())
    expected = evaluate(tmp_path / "labels", tmp_path / "ours")
    assert stored["results"] == expected["results"]
    assert list(stored["results"][0]) == [
        *("class", "metric", "iou", "recall_points", "range", "easy", "moderate", "hard", "n_gt")
    ]
    assert stored["results"][0]["range"] == [0, None]
    shown = capsys.readouterr()
    assert f"| Car | 2D R40 | 0.7 | all | {expected['results'][0]['easy']:.2f} |" in shown.out
    assert "WARNING: Car easy: only" in shown.err


def test_stdout_holds_json_alone_when_asked(folders: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert call(*folders, "--json", "-", "--classes", "Car", "--metrics", "3d", "--explain") == 0
    shown = capsys.readouterr()
    assert [row["iou"] for row in json.loads(shown.out)["results"]] == [0.7, 0.5]
    assert "Reasons for Car 3D IoU > 0.7, all, moderate" in shown.err


def test_options_reach_the_evaluator(folders: tuple[str, ...], tmp_path: Path) -> None:
    split = tmp_path / "split.txt"
    split.write_text("\n".join(f"{frame:06d}" for frame in range(20)))
    options = ["--recall", "11", "--iou-set", "loose", "--flavor", "python", "--range", "12", "inf", "--split", split]
    options += ["--range-rule", "border", "--range-axis", "radius", "--iou", "Car=0.3", "--iou", "Car=0.6"]
    assert call(*folders, *options, "--json", tmp_path / "ap.json") == 0
    expected = evaluate(
        tmp_path / "labels",
        tmp_path / "ours",
        recall=11,
        iou_set="loose",
        flavor="python",
        ranges=[(12, None)],
        range_rule="border",
        range_axis="radius",
        ious={"Car": [0.3, 0.6]},
        frames=[f"{frame:06d}" for frame in range(20)],
    )
    assert json.loads((tmp_path / "ap.json").read_text())["results"] == expected["results"]


def test_tables_and_curves_are_written(folders: tuple[str, ...], tmp_path: Path) -> None:
    places = ["--markdown", tmp_path / "ap.md", "--latex", tmp_path / "ap.tex", "--curves", tmp_path / "curves"]
    assert call(*folders, *places, "--classes", "Car", "--iou-set", "strict") == 0
    assert (tmp_path / "ap.md").read_text().startswith("| class |")
    assert (tmp_path / "ap.tex").read_text().startswith(r"\begin{tabular}")
    assert {path.name for path in (tmp_path / "curves").iterdir()} >= {"curves.csv", "curves_Car.png"}


def test_comparison_of_folders(folders: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    labels, other = random_frames(10, 30)
    write(tmp_path / "theirs", other)
    options = ["--classes", "Car", "--metrics", "2d", "--iou-set", "strict", "--json", tmp_path / "ap.json"]
    more = ["--compare", tmp_path / "theirs", "--compare", f"again={tmp_path / 'ours'}", "--bootstrap", "50"]
    assert call(*folders, *options, *more) == 0
    stored = json.loads((tmp_path / "ap.json").read_text())
    assert len(stored["intervals"]) == 3
    assert {(row["name"], row["baseline"]) for row in stored["differences"]} == {("theirs", "ours"), ("again", "ours")}
    assert all(row["difference"] == 0 for row in stored["differences"] if row["name"] == "again")
    assert "theirs - ours" in capsys.readouterr().out
    assert call(*folders, "--compare", tmp_path / "ours") == 2
    assert "use NAME=DIR" in capsys.readouterr().err
    assert len(labels) == 30


def test_explanations_name_frame_line_and_reason(folders: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert call(*folders, "--explain", "--classes", "Car", "--metrics", "2d") == 0
    shown = capsys.readouterr().out
    assert "label 1" in shown
    assert "IoU too low (line" in shown
    assert "Orientation of the matched: mean error" in shown


def test_a_likely_cause_of_zero_ap_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    labels = write(tmp_path / "labels", [[thing(x=x)] for x in range(12)])
    half = 0.75
    lifted = [[thing(x=x, score=1 + x, location=(x, 1.6 - half, 20.0))] for x in range(12)]
    found = write(tmp_path / "found", lifted)
    assert call("--labels", labels, "--detections", found, "--classes", "Car", "--metrics", "3d", "--json", "-") == 0
    shown = capsys.readouterr()
    assert "LIKELY CAUSE: y is the centre of the box" in shown.err
    assert len(json.loads(shown.out)["causes"]) == 1


def test_refusals_take_one_line_and_exit_2(
    folders: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "ours" / "000004.txt"
    broken.write_text("Car -1 -1 0 1 2 3\n")
    for arguments, words in (
        (folders, "000004.txt:1: expected 16 columns, got 7"),
        ((*folders, "--iou", "Car"), "--iou: expected CLASS=IOU"),
        ((*folders, "--range", "30", "10"), "LO < HI"),
        ((*folders, "--split", str(tmp_path / "none.txt")), "none.txt"),
        ((*folders, "--difficulty", "hard"), "difficulty: expected"),
    ):
        assert call(*arguments) == 2
        shown = capsys.readouterr()
        assert shown.err.startswith("error: ")
        assert words in shown.err
        assert shown.err.count("\n") == 1
        assert shown.out == ""


def test_lenient_continues_and_counts(folders: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "ours" / "000004.txt").write_text("Car -1 -1 0 1 2 3\nCar\n")
    (tmp_path / "ours" / "000005.txt").unlink()
    (tmp_path / "ours" / "000077.txt").write_text("")
    assert call(*folders, "--lenient", "--json", tmp_path / "ap.json") == 0
    skipped = json.loads((tmp_path / "ap.json").read_text())["skipped"]
    assert skipped == {"broken line": 2, "missing result file": 1, "result of unknown frame": 1}


# One option and the value it gives, for every field of the protocol.
PROTOCOL_OPTIONS = {
    "classes": (["--classes", "Car, Van"], ("Car", "Van")),
    "metrics": (["--metrics", "BEV,3d"], ("bev", "3d")),
    "recall": (["--recall", "11"], 11),
    "iou_set": (["--iou-set", "loose"], "loose"),
    "ious": (["--iou", "Car=0.3", "--iou", "Car=0.6"], {"Car": (0.3, 0.6)}),
    "flavor": (["--flavor", "python"], "python"),
    "ranges": (["--range", "0", "30", "--range", "30", "inf"], ((0, 30), (30, None))),
    "range_rule": (["--range-rule", "border"], "border"),
    "range_axis": (["--range-axis", "radius"], "radius"),
    "difficulty": (["--difficulty", "vkitti2:and"], "vkitti2:and"),
    "min_height": (["--min-height", "none"], "none"),
}


@pytest.mark.parametrize("name", [field.name for field in fields(EvaluationProtocol)])
def test_every_field_of_the_protocol_has_one_option_and_a_key(name: str) -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    options, value = PROTOCOL_OPTIONS[name]
    asked = protocol_of(parser.parse_args(["--labels", "a", "--detections", "b", *options]))
    assert asked == replace(EvaluationProtocol(), **{name: value}) != EvaluationProtocol()
    text = json.dumps(plain(value))
    assert load_config("nyuv2", [f"evaluation.{name}={text}"]).evaluation == asked
    group = next(group for group in parser._action_groups if group.title == "protocol")
    assert [action.dest for action in group._group_actions] == [field.name for field in fields(EvaluationProtocol)]
    assert all(action.help for action in group._group_actions)


def test_no_option_means_the_default_protocol() -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    assert protocol_of(parser.parse_args(["--labels", "a", "--detections", "b"])) == EvaluationProtocol()
