"""SIGKILL at random moments: a continued run ends with the same bytes and repeats only the frame in hand."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.pipeline.runner.damage import write_depth_folder
from tests.pipeline.test_cli import ROOT
from tests.pipeline.tiny_kitti import write_tiny_kitti

FRAMES, KILLS, SEED = 60, 20, 20261122


@pytest.fixture
def quick_folder(tmp_path: Path) -> Iterator[Path]:
    """A folder in memory where there is one: SIGKILL loses nothing that was written, flushed to a disk or not."""
    if not Path("/dev/shm").is_dir():
        yield tmp_path
        return
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        yield Path(folder)


@pytest.mark.slow
def test_a_run_killed_at_twenty_moments_ends_with_the_same_bytes_each_time(quick_folder: Path) -> None:
    tmp_path = quick_folder
    data = write_tiny_kitti(tmp_path / "kitti", FRAMES)
    depth = np.random.default_rng(1).integers(1200, 9000, (48, 96)).astype(np.uint16)
    write_depth_folder(tmp_path / "depth", depth, [f"{index:06d}" for index in range(FRAMES)])
    command = [
        "--config",
        "kitti",
        "--stage",
        "augment",
        "--workers",
        "1",
        "--set",
        "augment.preset=D",
        "--set",
        "augment.check_depth=false",
    ]
    command += ["--data", str(data), "--depth-from", str(tmp_path / "depth")]
    program = [sys.executable, "-m", "tests.pipeline.runner.killed_runs", str(tmp_path), str(KILLS), str(SEED)]
    done = subprocess.run([*program, *command], cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    kills = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(kills) == KILLS
    assert sum(kill["killed"] for kill in kills) >= KILLS - 2, "moments after the end of a run do not count"
    assert sum(0 < kill["noted"] < FRAMES for kill in kills) >= KILLS // 2
    for kill in kills:
        assert kill["ended"] == 0, kill
        assert kill["same"], kill
        assert kill["tasks"] == 0, kill
        assert kill["redone"] == [], kill  # what the ledger had was not done again: only the frame in hand was
        assert kill["damaged"] == [], kill  # a file is whole or not there
