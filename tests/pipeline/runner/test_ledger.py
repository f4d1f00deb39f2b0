"""The ledger: what it remembers, who reads it, and what happens when it is damaged."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.base.disk import no_more_files
from pipeline.base.errors import DataError, UsageError
from pipeline.run_folder.frame_outputs import Written, content_hash
from pipeline.runner.budget import DiskBudget
from pipeline.runner.jobs import Outcome, Task, crashed, outcome_of_error
from pipeline.runner.ledger import Ledger, all_failures
from tests.pipeline.runner.test_faults import mounted

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


def failing(path: Path, others: list[Path]) -> None:
    """A ledger in which TASK failed."""
    ledger = Ledger(path, others)
    ledger.record(outcome_of_error(TASK, DataError("a.bin", "points", "an empty file"), 0.1), "key")
    ledger.close()


@pytest.mark.parametrize("how", ["done", "looked at"])
def test_a_failure_of_another_shard_is_over_once_anyone_did_the_frame(tmp_path: Path, how: str) -> None:
    shard, whole = tmp_path / "ledger-1-of-2.sqlite", tmp_path / "ledger.sqlite"
    failing(shard, [])
    before = shard.read_bytes()
    ledger = Ledger(whole, [shard])
    if how == "done":
        ledger.record(DONE, "key")
    else:
        ledger.forget_failures("complete", ["000001"])
    ledger.close()
    assert all_failures([shard, whole]) == []
    assert shard.read_bytes() == before, "only its owner writes a ledger"
    time.sleep(0.01)
    failing(shard, [whole])  # it fails again, later
    assert len(all_failures([shard, whole])) == 1


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


def backdated(ledger: Ledger, path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The hash of a file, remembered as if it had lain there for a while."""
    now = time.time()
    with monkeypatch.context() as patch:
        patch.setattr("pipeline.runner.ledger.time.time", lambda: now + 10)
        return ledger.file_hash(path)


def test_a_file_edited_with_its_time_kept_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ledger = Ledger(tmp_path / "ledger.sqlite")
    path = tmp_path / "calib.txt"
    path.write_bytes(b"P2: 721")
    os.utime(path, ns=(10**18, 10**18))
    assert backdated(ledger, path, monkeypatch) == content_hash(b"P2: 721")
    path.write_bytes(b"P2: 999")
    os.utime(path, ns=(10**18, 10**18))
    assert ledger.file_hash(path) == content_hash(b"P2: 999")
    ledger.close()


def test_the_same_relative_name_in_another_folder_is_another_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger = Ledger(tmp_path / "ledger.sqlite")
    for folder, data in (("a", b"one"), ("b", b"two")):
        (tmp_path / folder).mkdir()
        path = tmp_path / folder / "x.bin"
        path.write_bytes(data)
        monkeypatch.chdir(path.parent)
        assert backdated(ledger, Path("x.bin"), monkeypatch) == content_hash(data)
    remembered = ledger._connection.execute("SELECT path FROM files ORDER BY path").fetchall()
    assert remembered == [(str(tmp_path / "a/x.bin"),), (str(tmp_path / "b/x.bin"),)]
    ledger.close()


def test_a_ledger_that_trusts_nothing_reads_every_file_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"one")
    answers = {}
    for trust in (True, False):
        ledger = Ledger(tmp_path / f"{trust}.sqlite", trust=trust)
        backdated(ledger, path, monkeypatch)
        ledger._connection.execute("UPDATE files SET hash = 'remembered'")
        ledger._connection.commit()
        answers[trust] = ledger.file_hash(path)
        ledger.close()
    assert answers == {True: "remembered", False: content_hash(b"one")}


VERSION_1 = """
CREATE TABLE done (stage TEXT NOT NULL, frame TEXT NOT NULL, key TEXT NOT NULL, written TEXT NOT NULL,
  seconds REAL NOT NULL, finished_at REAL NOT NULL, PRIMARY KEY (stage, frame));
CREATE TABLE failed (stage TEXT NOT NULL, frame TEXT NOT NULL, failure TEXT NOT NULL, PRIMARY KEY (stage, frame));
CREATE TABLE files (path TEXT PRIMARY KEY, size INTEGER NOT NULL, mtime_ns INTEGER NOT NULL, hash TEXT NOT NULL);
INSERT INTO done VALUES ('complete', '000001', 'key', '{}', 2.0, 1000.0);
INSERT INTO failed VALUES ('complete', '000002', '{"stage": "complete", "frame": "000002", "kind": "data",
  "file": "a.bin", "expected": "points", "found": "an empty file"}');
INSERT INTO files VALUES ('a.bin', 3, 5, 'abc');
"""


def test_a_ledger_of_the_first_version_keeps_its_rows(tmp_path: Path) -> None:
    path = tmp_path / "ledger.sqlite"
    with sqlite3.connect(path) as connection:
        connection.executescript(VERSION_1)
    connection.close()
    ledger = Ledger(path)
    row = ledger.row("complete", "000001")
    assert row is not None
    assert (row.key, row.seconds) == ("key", 2.0)
    assert [item.frame for item in all_failures([path])] == ["000002"]
    ledger.close()
    other = Ledger(tmp_path / "ledger-0-of-2.sqlite", [path])
    other.forget_failures("complete", ["000002"])
    other.close()
    assert all_failures([path, tmp_path / "ledger-0-of-2.sqlite"]) == []


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("PRAGMA user_version = 99", "a ledger of a newer program (its tables are version 99, this one knows 2)"),
        ("CREATE TABLE done (stage TEXT, frame TEXT)", "its table 'done' has other columns"),
        ("PRAGMA user_version = 2; CREATE TABLE files (path TEXT)", "its table 'files' has other columns"),
    ],
)
def test_ledgers_that_cannot_be_used_say_what_they_are(tmp_path: Path, script: str, said: str) -> None:
    path = tmp_path / "ledger.sqlite"
    connection = sqlite3.connect(path)
    connection.executescript(script)
    connection.close()
    with pytest.raises(UsageError) as refusal:
        Ledger(path)
    assert said in str(refusal.value)
    assert str(refusal.value).startswith(f"{path}: ")


def test_a_locked_ledger_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.runner.ledger_file.WAIT_SECONDS", 0.1)
    path = tmp_path / "ledger.sqlite"
    Ledger(path).close()
    holder = sqlite3.connect(path)
    holder.execute("BEGIN EXCLUSIVE")
    with pytest.raises(UsageError, match="another process held it for 0 s: wait until that one has finished"):
        Ledger(path)
    holder.close()


@pytest.fixture
def few_inodes(tmp_path: Path) -> Iterator[Path]:
    """A file system of 16 MB with room for eight files."""
    folder = mounted(tmp_path / "few", "size=16m,nr_inodes=8")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_exhausted_inodes_are_told_from_a_full_disk(few_inodes: Path) -> None:
    assert no_more_files(few_inodes) == ""
    number = 0
    while not no_more_files(few_inodes):
        (few_inodes / str(number)).write_bytes(b"")
        number += 1
    with pytest.raises(OSError, match="No space left") as refusal:
        (few_inodes / "last").write_bytes(b"")
    failure = outcome_of_error(TASK, refusal.value, 0.1)
    assert "no further file fits (8 inodes are used up, 0.02 GB are free)" in failure.fatal
    assert "inodes" in DiskBudget(few_inodes, 0.0, None).exceeded()
    with pytest.raises(UsageError, match=r"ledger\.sqlite: .*no further file fits \(8 inodes"):
        Ledger(few_inodes / "ledger.sqlite")


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
