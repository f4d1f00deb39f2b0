"""The Ray engine: the same bytes as local processes, also when a worker is killed; one clear line without Ray."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.cli import main
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
