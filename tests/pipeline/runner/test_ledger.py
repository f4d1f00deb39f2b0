"""The ledger: what it remembers, who reads it, and what happens when it is damaged."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from pipeline.base.errors import DataError, UsageError
from pipeline.run_folder.frame_outputs import Written, content_hash
from pipeline.runner.jobs import Outcome, Task, crashed, outcome_of_error
from pipeline.runner.ledger import Ledger, all_failures

TASK = Task("complete", "000001")
DONE = Outcome(TASK, {"depth/000001.png": Written(12, "abc")}, seconds=2.0)


def test_a_finished_task_is_remembered_over_processes(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "run" / "ledger.sqlite")
    assert ledger.row("complete", "000001") is None
    ledger.record(DONE, "key")
    ledger.close()
    again = Ledger(tmp_path / "run" / "ledger.sqlite")
    row = again.row("complete", "000001")
    assert row is not None
    assert (row.key, row.written, row.seconds) == ("key", DONE.written, 2.0)
    assert again.mean_seconds("complete") == 2.0
    assert again.mean_seconds("detect") is None
    again.close()


def test_shards_see_what_others_finished_the_latest_first(tmp_path: Path) -> None:
    first, second = tmp_path / "ledger-0-of-2.sqlite", tmp_path / "ledger-1-of-2.sqlite"
    ledger = Ledger(first)
    ledger.record(DONE, "old")
    ledger.close()
    other = Ledger(second, [first, second])
    row = other.row("complete", "000001")
    assert row is not None
    assert row.key == "old"
    other.record(DONE, "new")
    other.close()
    seen = Ledger(tmp_path / "ledger.sqlite", [first, second])
    row = seen.row("complete", "000001")
    seen.close()
    assert row is not None
    assert row.key == "new"


def test_failures_are_kept_until_the_task_is_done(tmp_path: Path) -> None:
    path = tmp_path / "ledger.sqlite"
    ledger = Ledger(path)
    error = DataError("a.bin", "points", "an empty file", "copy it again")
    ledger.record(outcome_of_error(TASK, error, 0.1), "key")
    (failure,) = all_failures([path])
    assert failure.line() == "complete: frame 000001: a.bin: expected points, got an empty file; copy it again"
    assert ledger.row("complete", "000001") is None
    ledger.record(DONE, "key")
    assert all_failures([path]) == []
    ledger.close()


def test_file_hashes_follow_the_contents(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "ledger.sqlite")
    path = tmp_path / "a"
    assert ledger.file_hash(path) == "absent"
    path.write_bytes(b"one")
    os.utime(path, (time.time() - 100, time.time() - 100))
    assert ledger.file_hash(path) == content_hash(b"one")
    path.write_bytes(b"two")  # same size, new time stamp
    assert ledger.file_hash(path) == content_hash(b"two")
    path.write_bytes(b"six")  # within the same clock tick: must not be mistaken for "two"
    assert ledger.file_hash(path) == content_hash(b"six")
    ledger.close()


def test_a_damaged_ledger_is_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "ledger.sqlite"
    path.write_bytes(b"this is no database" * 100)
    with pytest.raises(UsageError, match="ledger is damaged: remove it"):
        Ledger(path)


def test_a_file_in_place_of_the_run_folder(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("")
    with pytest.raises(UsageError, match="run: cannot be written"):
        Ledger(tmp_path / "run" / "ledger.sqlite")


def test_every_error_becomes_an_outcome() -> None:
    import errno

    full = outcome_of_error(TASK, OSError(errno.ENOSPC, "No space left", "depth/1.png"), 0.1)
    assert full.fatal == "the disk is full (depth/1.png)"
    bug = outcome_of_error(TASK, ZeroDivisionError("x"), 0.1).failure
    assert bug is not None
    assert (bug.kind, bug.found) == ("unexpected", "ZeroDivisionError: x")
    killed = crashed(TASK, -9).failure
    assert killed is not None
    assert "signal 9" in killed.line()
    assert "fewer --workers" in killed.line()
