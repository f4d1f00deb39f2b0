"""Leakage: frames that share a raw drive with a model's training data."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipeline.base.errors import DataError, UsageError
from pipeline.check.leakage import BUILT_IN, RawFrame, find_leakage, read_mapping, read_training
from tests.conftest import sample_folder


@pytest.fixture
def mapping_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "mapping"
    folder.mkdir()
    rows = [
        "2011_09_26 2011_09_26_drive_0005_sync 0000000109",
        "2011_09_26 2011_09_26_drive_0009_sync 0000000001",
        "2011_09_28 2011_09_28_drive_0001_sync 0000000007",
    ]
    (folder / "train_mapping.txt").write_text("\n".join(rows) + "\n")
    (folder / "train_rand.txt").write_text("3,1,2\n")
    return folder


def test_frames_are_permuted_line_numbers(mapping_folder: Path) -> None:
    assert read_mapping(mapping_folder) == {
        "000000": RawFrame("2011_09_28_drive_0001", 7),
        "000001": RawFrame("2011_09_26_drive_0005", 109),
        "000002": RawFrame("2011_09_26_drive_0009", 1),
    }


def test_drives_frames_and_folders_as_training_lists(mapping_folder: Path, tmp_path: Path) -> None:
    mapping = read_mapping(mapping_folder)
    drives = tmp_path / "drives.txt"
    drives.write_text("2011_09_26_drive_0009_sync\n2011_10_03_drive_0042_sync 0000000011\n")
    result = find_leakage(mapping, mapping, read_training(str(drives), mapping))
    assert (result.shared_drive, result.shared_frame) == (("000002",), ())
    frames = tmp_path / "frames.txt"
    frames.write_text("000001\ntrain/2011_09_28_drive_0001_sync/image_02/0000000007\n")
    result = find_leakage(["000000", "000001", "000002"], mapping, read_training(str(frames), mapping))
    assert result.shared_frame == ("000000", "000001")
    folder = tmp_path / "train"
    (folder / "2011_09_26_drive_0005_sync").mkdir(parents=True)
    result = find_leakage(mapping, mapping, read_training(str(folder), mapping))
    assert result.drives == {"2011_09_26_drive_0005": 1}


def test_depth_training_drives_are_all_but_the_validation_ones(mapping_folder: Path) -> None:
    mapping = read_mapping(mapping_folder)
    result = find_leakage(mapping, mapping, read_training(BUILT_IN, mapping))
    # Drive 0005 of 2011_09_26 is one of the benchmark's validation drives.
    assert result.shared_drive == ("000000", "000002")


def test_what_is_refused(mapping_folder: Path, tmp_path: Path) -> None:
    mapping = read_mapping(mapping_folder)
    bad = tmp_path / "bad.txt"
    bad.write_text("somewhere\n")
    with pytest.raises(UsageError, match="names no raw drive"):
        read_training(str(bad), mapping)
    with pytest.raises(UsageError, match="1 of 1 frames are not in the mapping"):
        find_leakage(["999999"], mapping, read_training(BUILT_IN, mapping))
    (mapping_folder / "train_rand.txt").write_text("4\n")
    with pytest.raises(DataError, match="line numbers"):
        read_mapping(mapping_folder)
    with pytest.raises(UsageError, match="no such file"):
        read_mapping(tmp_path)


def test_the_verb_on_the_real_mapping(kitti_object: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from pipeline.cli import main

    mapping = sample_folder("mapping")
    val = kitti_object / "ImageSets" / "val.txt"
    arguments = ["--stage", "check", "--leakage", "--mapping", str(mapping), "--frames", str(val), "--json"]
    assert main([*arguments, "--train-list", BUILT_IN]) == 1
    record = json.loads(capsys.readouterr().out)
    assert record["frames"] == 3769
    assert record["leaking"] == sum(record["drives"].values())
    clean = tmp_path / "drives.txt"
    clean.write_text("2099_01_01_drive_0001_sync\n")
    assert main([*arguments, "--train-list", str(clean)]) == 0
