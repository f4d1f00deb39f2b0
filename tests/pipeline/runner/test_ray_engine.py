"""The Ray engine: the same bytes as local processes, also when a worker is killed; one clear line without Ray."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import time
import uuid
from pathlib import Path

import pytest

from pipeline.cli import main
from tests.pipeline.left_behind import ENDS_WITHIN, marked, started
from tests.pipeline.test_cli import AUGMENT, ROOT, contents, done_frames
from tests.pipeline.tiny_kitti import write_tiny_kitti


def test_without_ray_the_request_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(["--engine", "ray", "--out", str(tmp_path / "run")]) == 2
    assert capsys.readouterr().err.endswith("pip install 'auglidar[ray]', or use --engine local\n")


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install 'auglidar[ray]'")
def test_a_cluster_of_two_nodes_gives_the_same_bytes_while_a_worker_is_killed(tmp_path: Path) -> None:
    data = write_tiny_kitti(tmp_path / "kitti", 10)
    command = [*AUGMENT, "--data", str(data)]
    assert main([*command, "--workers", "1", "--out", str(tmp_path / "local")]) == 0
    flag, out = tmp_path / "killed", tmp_path / "ray"
    program = [sys.executable, "-m", "tests.pipeline.runner.ray_cluster", str(flag), "000004"]
    done = subprocess.run(
        [*program, *command, "--engine", "ray", "--out", str(out)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    assert flag.exists(), "no worker was killed"
    assert contents(out) == contents(tmp_path / "local")
    assert len(done_frames(out, "augment")) == 10
    assert not (out / "failures.json").exists()


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install 'auglidar[ray]'")
def test_after_a_killed_driver_nothing_stays(tmp_path: Path) -> None:
    """Ray ties the nodes it starts for a driver to that driver, and actors end with their nodes."""
    mark = uuid.uuid4().hex
    data = write_tiny_kitti(tmp_path / "kitti", 200)
    program = started(["pipeline.cli", *AUGMENT, "--data", str(data), "--engine", "ray", "--out", str(tmp_path)], mark)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("cloud/*.bin")) and program.poll() is None and time.monotonic() < deadline:
        time.sleep(0.1)
    assert program.poll() is None, program.communicate()
    program.kill()
    program.communicate()
    end = time.monotonic() + ENDS_WITHIN
    while marked(mark) and time.monotonic() < end:
        time.sleep(0.1)
    assert marked(mark) == {}
