"""A full disk, a folder that cannot be written, two processes on one output, and memory that does not grow."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pipeline.cli import main
from tests.pipeline.runner.damage import write_depth_folder
from tests.pipeline.test_cli import ROOT, contents, done_frames, start
from tests.pipeline.tiny_kitti import HEIGHT, WIDTH, write_tiny_kitti

OPTIONS = (
    "--config",
    "kitti",
    "--stage",
    "augment",
    "--set",
    "augment.preset=D",
    "--set",
    "augment.check_depth=false",
    "--workers",
    "1",
)


def cheap_run(folder: Path, frames: int) -> list[str]:
    """A command whose frames cost milliseconds: depth is read, not completed."""
    data = write_tiny_kitti(folder / "kitti", frames)
    depth = np.full((HEIGHT, WIDTH), 2560, np.uint16)
    write_depth_folder(folder / "depth", depth, [f"{index:06d}" for index in range(frames)])
    return [*OPTIONS, "--data", str(data), "--depth-from", str(folder / "depth")]


def mounted(folder: Path, kind: str) -> Path:
    """`folder` as a mount of its own; a skip when that is not allowed here."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", kind, "tmpfs", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False) if shutil.which("mount") else None
    if done is None or done.returncode != 0:
        pytest.skip(f"cannot mount a small tmpfs: {'no mount command' if done is None else done.stderr.strip()}")
    return folder


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 1 MB."""
    folder = mounted(tmp_path / "small", "size=1m")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.fixture
def read_only(tmp_path: Path) -> Iterator[Path]:
    folder = mounted(tmp_path / "locked", "ro,size=1m")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.parametrize("keep_free_gb", ["0", "0.0003"], ids=["until it is full", "with a reserve"])
def test_a_full_disk_ends_in_a_line_and_the_run_continues_with_more_room(
    tmp_path: Path, small_disk: Path, keep_free_gb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    command = cheap_run(tmp_path, 24)
    assert main([*command, "--out", str(tmp_path / "roomy")]) == 0
    out = small_disk / "run"
    capsys.readouterr()
    assert main([*command, "--out", str(out), "--set", f"run.keep_free_gb={keep_free_gb}"]) in (1, 2)
    error = capsys.readouterr().err
    assert ("the disk is full" if keep_free_gb == "0" else "are to be kept (run.keep_free_gb)") in error
    assert "Traceback" not in error
    finished = done_frames(out, "augment")
    assert 0 < len(finished) < 24
    written, expected = contents(out), contents(tmp_path / "roomy")
    assert {name for name in written if written[name] != expected[name]} == set()
    assert not list(out.rglob(".writing-*"))
    subprocess.run(["mount", "-o", "remount,size=16m", str(small_disk)], check=True)
    assert main([*command, "--out", str(out), "--set", "run.keep_free_gb=0"]) == 0
    after = done_frames(out, "augment")
    assert {frame: after[frame] for frame in finished} == finished
    assert contents(out) == expected


def test_a_read_only_disk_is_one_line(tmp_path: Path, read_only: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = cheap_run(tmp_path, 1)
    capsys.readouterr()
    assert main([*command, "--out", str(read_only / "run")]) == 2
    error = capsys.readouterr().err
    assert "cannot be written: Read-only file system" in error
    assert error.count("\n") == 1


def test_two_processes_on_one_output_end_with_the_right_bytes(tmp_path: Path) -> None:
    command = cheap_run(tmp_path, 12)
    assert main([*command, "--out", str(tmp_path / "alone")]) == 0
    out = tmp_path / "shared"
    shards = [["--shard", "0/2"], []]
    processes = [start([*command, "--out", str(out), *shard]) for shard in shards]
    for process in processes:
        _, error = process.communicate(timeout=100)
        assert process.returncode == 0, error
    assert contents(out) == contents(tmp_path / "alone")
    assert len(done_frames(out, "augment")) == 12


RESIDENT = """
import sys
from pathlib import Path
from pipeline.runner.ledger import Ledger
from pipeline.cli import main

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1])

pages, record = [], Ledger.record
def noted(self, outcome, key):
    record(self, outcome, key)
    pages.append(resident())
Ledger.record = noted
assert main(sys.argv[1:]) == 0
print(pages[49], pages[-1], len(pages))
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read from /proc")
def test_memory_after_a_thousand_frames_is_that_after_fifty(tmp_path: Path) -> None:
    home = Path("/dev/shm") if Path("/dev/shm").is_dir() else tmp_path
    folder = home / f"auglidar-{os.getpid()}"
    try:
        command = [*many_frames(folder, 1000), "--out", str(folder / "run")]
        done = subprocess.run(
            [sys.executable, "-c", RESIDENT, *command],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
            timeout=200,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    assert done.returncode == 0, done.stderr[-2000:]
    early, late, frames = (int(word) for word in done.stdout.split()[-3:])
    assert frames == 1000
    assert abs(late - early) < 0.05 * early, (early, late)


def many_frames(folder: Path, frames: int) -> list[str]:
    """`cheap_run` with the files of one frame under many names (hard links: the same bytes, other paths)."""
    command = cheap_run(folder, 1)
    for path in [path for path in folder.rglob("000000.*") if path.is_file()]:
        for index in range(1, frames):
            os.link(path, path.with_name(f"{index:06d}{path.suffix}"))
    return command
