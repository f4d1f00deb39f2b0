"""Failures end when their frame is done or gone; results follow inputs whose size and time were kept."""

from __future__ import annotations

import os
import shutil
import sqlite3
import time
from pathlib import Path

import pytest

from pipeline.cli import main
from tests.pipeline.runner.test_faults import OPTIONS, cheap_run
from tests.pipeline.test_cli import contents


def test_a_frame_that_failed_in_a_shard_and_is_done_by_a_whole_run_is_mended(tmp_path: Path) -> None:
    command, run = [*cheap_run(tmp_path, 4)], tmp_path / "run"
    calibration = tmp_path / "kitti" / "training" / "calib" / "000001.txt"
    whole = calibration.read_bytes()
    calibration.write_bytes(b"")
    assert main([*command, "--out", str(run), "--shard", "1/2"]) == 1
    calibration.write_bytes(whole)
    assert main([*command, "--out", str(run)]) == 0
    assert not (run / "failures.json").exists()
    assert main([*command, "--out", str(run), "--shard", "0/2"]) == 0


def test_a_frame_that_is_gone_or_not_asked_for_has_not_failed(tmp_path: Path) -> None:
    command, run = [*cheap_run(tmp_path, 4), "--out", str(tmp_path / "run")], tmp_path / "run"
    training = tmp_path / "kitti" / "training"
    (training / "calib" / "000001.txt").write_bytes(b"")
    assert main([*command, "--shard", "1/2"]) == 1
    assert main([*command, "--shard", "0/2"]) == 1, "the run has a failed frame, whichever shard it was in"
    assert main([*command, "--frames", "2:4"]) == 0
    assert not (run / "failures.json").exists()
    assert main(command) == 1
    for path in [*training.rglob("000001.*"), tmp_path / "depth" / "000001.png"]:
        path.unlink()
    assert main(command) == 0
    assert not (run / "failures.json").exists()


def change_focal_length(calibration: Path) -> None:
    """Another first digit of P2: the file keeps its size."""
    text = calibration.read_text()
    digit = text.index("P2: ") + len("P2: ")
    calibration.write_text(text[:digit] + str(int(text[digit]) % 9 + 1) + text[digit + 1 :])


def test_a_calibration_edited_with_its_time_kept_gives_a_new_cloud(tmp_path: Path) -> None:
    command, run = [*cheap_run(tmp_path, 1), "--out", str(tmp_path / "run")], tmp_path / "run"
    path = tmp_path / "kitti" / "training" / "calib" / "000000.txt"
    os.utime(path, ns=(10**18, 10**18))
    time.sleep(2.1)  # files that changed just now are not remembered
    assert main(command) == 0
    before = contents(run)
    size = path.stat().st_size
    change_focal_length(path)
    assert path.stat().st_size == size
    os.utime(path, ns=(10**18, 10**18))
    assert main(command) == 0
    assert contents(run) != before


def test_the_same_command_in_another_folder_reads_that_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cheap_run(tmp_path / "a", 1)
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    other = next((tmp_path / "b").rglob("calib/000000.txt"))
    change_focal_length(other)
    for path in [*(tmp_path / "a").rglob("*"), *(tmp_path / "b").rglob("*")]:
        os.utime(path, ns=(10**18, 10**18))
    time.sleep(2.1)
    command = [*OPTIONS, "--data", "kitti", "--depth-from", "depth"]
    clouds = []
    for folder in ("a", "b"):
        monkeypatch.chdir(tmp_path / folder)
        assert main([*command, "--out", str(tmp_path / "run")]) == 0
        clouds.append(contents(tmp_path / "run"))
    assert clouds[0] != clouds[1]


def test_verify_reads_what_the_ledger_remembers(tmp_path: Path) -> None:
    command, run = [*cheap_run(tmp_path, 1), "--out", str(tmp_path / "run")], tmp_path / "run"
    time.sleep(2.1)
    assert main(command) == 0
    cloud = run / "cloud" / "000000.bin"
    whole = cloud.read_bytes()
    # As a disk that forgets bytes would: other contents under signs that did not change.
    time.sleep(2.1)
    assert main(command) == 0
    cloud.write_bytes(b"\0" * len(whole))
    status = cloud.stat()
    with sqlite3.connect(run / "ledger.sqlite") as ledger:
        signs = (status.st_mtime_ns, status.st_ctime_ns, status.st_ino, str(cloud))
        ledger.execute("UPDATE files SET mtime_ns = ?, ctime_ns = ?, inode = ? WHERE path = ?", signs)
    ledger.close()
    assert main(command) == 0
    assert cloud.read_bytes() != whole
    assert main([*command, "--verify"]) == 0
    assert cloud.read_bytes() == whole
