"""Killed commands leave no process behind. All signals and moments: `python -m tests.pipeline.left_behind`."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from tests.pipeline.left_behind import command, killed, many_frames


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "number", "after"),
    [
        ("synth", signal.SIGTERM, 0.0),
        ("check", signal.SIGINT, 0.3),
        ("export", signal.SIGKILL, 0.3),
        ("frames", signal.SIGKILL, 0.0),
    ],
)
def test_no_process_stays(tmp_path: Path, name: str, number: signal.Signals, after: float) -> None:
    data = tmp_path if name == "synth" else many_frames(tmp_path / "data")
    end = killed(command(name, data, tmp_path / "out"), number, after)
    assert end.stayed == ()
    assert end.code == (-number if number == signal.SIGKILL else 128 + number)
    assert "Traceback" not in end.error
