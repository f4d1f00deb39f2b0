"""Lines of progress: seldom, and with a time left that the first, slow frame does not spoil."""

from __future__ import annotations

import itertools

import pytest

from pipeline.base import progress


def test_the_first_frame_is_not_extrapolated(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # Start, a first frame of 60 s that compiles, then 2 s each.
    ticks = itertools.chain([0.0], itertools.count(60.0, 2.0))
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(ticks))
    with progress._lines("complete", 21) as counter:
        for _ in range(21):
            counter.advance()
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "complete: 9 of 21 frames, about 24.0 s left"
    assert lines[-1] == "complete: 21 of 21 frames in 1 min 42 s"
    assert len(lines) == 3


def test_a_stage_without_frames_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with progress._lines("detect", 0):
        pass
    assert capsys.readouterr().err == ""
