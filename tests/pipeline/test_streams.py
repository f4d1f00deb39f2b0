"""Standard streams that are closed, full or of few letters, names that are no text: the work is done, or one line."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest

from pipeline import cli
from tests.pipeline.runner.test_faults import cheap_run, mounted

ROOT = Path(__file__).resolve().parents[2]
LINE = "Car -1 -1 -1.58 587.01 173.33 614.12 200.12 1.65 1.67 3.64 -0.65 1.71 46.70 -1.59 0.9\n"


@pytest.fixture
def detections(tmp_path: Path) -> Path:
    folder = tmp_path / "größe"
    folder.mkdir()
    (folder / "000000.txt").write_text(LINE)
    return folder


def in_shell(arguments: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """The program as a shell starts it, with its redirections."""
    return subprocess.run(
        ["bash", "-c", f"{sys.executable} -m pipeline.cli {arguments}"],
        cwd=folder,
        capture_output=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
    )


@pytest.mark.parametrize(
    ("redirection", "code", "said"),
    [
        (">&-", 0, b""),
        ("2>&-", 0, b""),
        ("2>/dev/full", 0, b""),
        (">&- 2>&- <&-", 0, b""),
        ("| true; exit ${PIPESTATUS[0]}", 0, b""),
        (">/dev/full", 2, b"run_pipeline: standard output could not be written: No space left on device\n"),
    ],
)
def test_the_work_is_done_whatever_became_of_the_streams(
    detections: Path, redirection: str, code: int, said: bytes
) -> None:
    command = "--stage pack --detections . --test-frames 1 --archive a.zip"
    done = in_shell(f"{command} {redirection}", detections)
    assert (done.returncode, done.stderr) == (code, said)
    assert (detections / "a.zip").read_bytes().startswith(b"PK")


def test_frames_are_done_without_a_place_for_their_summary(tmp_path: Path) -> None:
    command = " ".join([*cheap_run(tmp_path, 2), "--out", str(tmp_path / "run")])
    assert in_shell(f"{command} >&- 2>/dev/full", tmp_path).returncode == 0
    assert len(list((tmp_path / "run" / "cloud").glob("*.bin"))) == 2


def test_letters_that_the_terminal_lacks_are_escaped(detections: Path) -> None:
    command = f"--stage pack --detections {detections} --test-frames 1 --archive {detections}/a.zip"
    done = in_shell(command, detections, PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"/gr\\xf6\\xdfe/a.zip: 1 result files" in done.stdout


def test_a_name_that_the_locale_cannot_tell_is_one_line(detections: Path) -> None:
    plain = {"LC_ALL": "POSIX", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    done = in_shell(f"--stage pack --detections {detections}", detections, **plain)
    assert done.returncode == 2
    assert done.stderr.count(b"\n") == 1
    assert b"set PYTHONUTF8=1 or LC_ALL=C.UTF-8" in done.stderr


def test_a_run_below_a_folder_that_the_locale_cannot_tell(tmp_path: Path) -> None:
    folder = tmp_path / "größe"
    folder.mkdir()
    command = " ".join(word.replace(f"{folder}/", "") for word in cheap_run(folder, 2))
    (folder / "kitti" / "training" / "calib" / "000001.txt").write_bytes(b"")
    plain = {"LC_ALL": "POSIX", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    done = in_shell(f"{command} --out run", folder, **plain)
    assert done.returncode == 1, done.stderr
    assert b"Traceback" not in done.stderr
    assert len(list((folder / "run" / "cloud").glob("*.bin"))) == 1


def test_a_full_disk_in_pack_is_one_line(tmp_path: Path, detections: Path, capsys: pytest.CaptureFixture[str]) -> None:
    disk = mounted(tmp_path / "small", "size=16k")
    try:
        (disk / "filler").write_bytes(b"\0" * 12288)
        archive = disk / "a.zip"
        for index in range(1, 150):
            (detections / f"{index:06d}.txt").write_text(LINE)
        command = ["--stage", "pack", "--detections", str(detections), "--test-frames", "150"]
        assert cli.main([*command, "--archive", str(archive)]) == 2
        assert (
            capsys.readouterr().err.splitlines()[-1] == f"run_pipeline: {archive}: cannot be written: the disk is full"
        )
        assert [path.name for path in disk.iterdir()] == ["filler"]
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(5, "Input/output error", "a.bin"), "a.bin: Input/output error"),
        (MemoryError(), "not enough memory"),
        (BrokenProcessPool(), "a worker process was ended"),
    ],
)
def test_trouble_of_the_machine_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception, said: str
) -> None:
    def fails(_: object) -> int:
        raise error

    monkeypatch.setattr(cli, "_dispatch", fails)
    assert cli.main([]) == 2
    assert said in capsys.readouterr().err


def test_a_fault_of_the_program_is_not_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "_dispatch", lambda _: {}["missing"])
    assert cli.program() == cli.FAULT == 70
    assert "KeyError: 'missing'" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["--frames", "0:" + "9" * 5000],
        ["--set", "seed=" + "9" * 5000],
        ["--set", "seed=[&a [1], *a, *a, *a, *a]"],
        ["--set", f"seed=[&a [{'1,' * 999}1], &b [{'*a,' * 99}*a], [{'*b,' * 99}*b]]"],
    ],
)
def test_numbers_and_aliases_without_end_are_one_line(
    tmp_path: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    command = [*cheap_run(tmp_path, 1), "--out", str(tmp_path / "run")]
    assert cli.main([*command, *arguments]) == 2
    assert capsys.readouterr().err.count("\n") == 1
