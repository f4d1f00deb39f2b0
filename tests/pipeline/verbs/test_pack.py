"""`--stage pack` as a user meets it."""

from __future__ import annotations

import argparse
import zipfile
from pathlib import Path

import pytest

from detection.kitti_format import format_line
from pipeline.verbs.pack import add_arguments, run
from tests.detection.evaluation.scenes import thing


def call(*arguments: str | Path) -> int:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return run(parser.parse_args([str(argument) for argument in arguments]))


@pytest.fixture
def results(tmp_path: Path) -> Path:
    folder = tmp_path / "detections"
    folder.mkdir()
    for frame in range(3):
        (folder / f"{frame:06d}.txt").write_text(format_line(thing(score=0.1 * frame)) + "\n")
    return folder


def test_packs_a_sound_folder(results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    archive = tmp_path / "out" / "submission.zip"
    assert call("--detections", results, "--archive", archive, "--test-frames", "3") == 0
    with zipfile.ZipFile(archive) as packed:
        assert packed.namelist() == ["000000.txt", "000001.txt", "000002.txt"]
    assert "3 result files at the root" in capsys.readouterr().out
    assert [path.name for path in archive.parent.iterdir()] == ["submission.zip"]


def test_refuses_the_wrong_count_and_says_so(results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    archive = tmp_path / "submission.zip"
    assert call("--detections", results, "--archive", archive) == 2
    assert "7515 of 7518 result files are missing, first 000003.txt" in capsys.readouterr().err
    assert not archive.exists()
    assert call("--detections", results, "--archive", archive, "--fill-missing") == 0
    with zipfile.ZipFile(archive) as packed:
        assert len(packed.namelist()) == 7518
        assert packed.namelist()[-1] == "007517.txt"
