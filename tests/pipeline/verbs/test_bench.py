"""`run_pipeline --stage bench` on two synthetic streets: tables, files, and frames without labels."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from pipeline.cli import main
from pipeline.simulation.synth import SynthSettings
from pipeline.simulation.writers import write_dataset

BENCH = ["--stage", "bench", "--suite", "real", "--rows", "16", "--completers", "nearest"]


@pytest.fixture(scope="module")
def streets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("streets")
    write_dataset(root, SynthSettings(frames=2, seed=3))
    return root


def test_depth_cars_and_masks(streets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    masks = ["--detectors", "small_lidar", "--masks", "truth"]
    assert main([*BENCH, *masks, "--data", str(streets), "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert (tmp_path / "real.md").read_text() == printed.rstrip("\n") + "\n"
    assert [line for line in printed.splitlines() if line and line[0] != "|"] == [
        "Completion on held-out rings, 2 frames (mm; %; s per frame)",
        "Objects found, 2 frames, augmented clouds from classical (found/labelled; precision)",
        "LiDAR points under masks, 2 frames (against the points in labelled 3D boxes)",
    ]
    found = json.loads((tmp_path / "real.json").read_text())
    assert [(entry["method"], entry["rows"]) for entry in found["completion"]] == [("nearest", 16)]
    assert [(entry["rows"], len(entry["reports"])) for entry in found["detection"]] == [(64, 12), (16, 12)]
    assert [(entry["mask"], entry["group"]) for entry in found["masks"]] == [("truth", "vehicles"), ("truth", "people")]


def test_frames_without_labels(streets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = tmp_path / "unlabelled"
    shutil.copytree(streets, root)
    shutil.rmtree(root / "training" / "label_2")
    assert main([*BENCH, "--data", str(root), "--json"]) == 0
    printed = capsys.readouterr()
    assert set(json.loads(printed.out)) == {"frames", "completion"}
    assert "objects and masks are not measured" in printed.err


@pytest.mark.parametrize(
    ("option", "known"),
    [("--completers", "selection_small"), ("--detectors", "small_lidar"), ("--masks", "truth, boxes, files:FOLDER")],
)
def test_wrong_names_are_told_before_anything_is_measured(
    option: str, known: str, streets: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*BENCH, "--data", str(streets), option, "nothing"]) == 2
    printed = capsys.readouterr()
    assert known in printed.err
    assert "completion 0" not in printed.err
