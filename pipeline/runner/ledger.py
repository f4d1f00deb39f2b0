"""The ledger: one SQLite file per shard with a row per finished (stage, frame), and the failures.

SQLite gives durability: a row is either there after a power loss or it is not, and the files it names were flushed
before it was written. Only the process that owns a shard writes its ledger; every process reads all of them.
"""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import UsageError
from pipeline.frame_files import Written, content_hash
from pipeline.runner.jobs import Failure, Outcome

_SCHEMA = """
CREATE TABLE IF NOT EXISTS done (
  stage TEXT NOT NULL, frame TEXT NOT NULL, key TEXT NOT NULL, written TEXT NOT NULL, seconds REAL NOT NULL,
  finished_at REAL NOT NULL, PRIMARY KEY (stage, frame));
CREATE TABLE IF NOT EXISTS failed (
  stage TEXT NOT NULL, frame TEXT NOT NULL, failure TEXT NOT NULL, PRIMARY KEY (stage, frame));
CREATE TABLE IF NOT EXISTS files (
  path TEXT PRIMARY KEY, size INTEGER NOT NULL, mtime_ns INTEGER NOT NULL, hash TEXT NOT NULL);
"""


@dataclass(frozen=True)
class Row:
    """A finished task: what it depended on (`key`), what it wrote, how long it took."""

    key: str
    written: dict[str, Written]
    seconds: float
    finished_at: float


class Ledger:
    """The ledger of this process, and what the other shards' ledgers of the same run said when it was opened."""

    def __init__(self, path: Path, others: Iterable[Path] = ()) -> None:
        """Raises UsageError when the folder cannot be written or a ledger is damaged."""
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._connection = sqlite3.connect(path, timeout=60)
            self._connection.execute("PRAGMA synchronous = FULL")
            self._connection.executescript(_SCHEMA)
            self._done = _rows(self._connection)
        except OSError as error:
            raise UsageError(f"{path.parent}: cannot be written: {error.strerror}") from None
        except sqlite3.DatabaseError as error:
            raise UsageError(f"{path}: {error}; {_hint(error)}") from None
        self._others = _read_others([other for other in others if other != path])

    def close(self) -> None:
        """Closes the file."""
        self._connection.close()

    def row(self, stage: str, frame: str) -> Row | None:
        """The last time this task was finished, by any shard."""
        rows = [rows[stage, frame] for rows in (self._done, self._others) if (stage, frame) in rows]
        return max(rows, key=lambda row: row.finished_at, default=None)

    def record(self, outcome: Outcome, key: str) -> None:
        """Writes what became of a task; durable when the call returns."""
        stage, frame = outcome.task.stage, outcome.task.frame
        with self._connection:
            if outcome.failure is not None:
                text = json.dumps(outcome.failure.as_dict())
                self._connection.execute("REPLACE INTO failed VALUES (?, ?, ?)", (stage, frame, text))
                return
            row = Row(key, outcome.written, outcome.seconds, time.time())
            written = json.dumps({name: [file.size, file.hash] for name, file in row.written.items()})
            values = (stage, frame, key, written, row.seconds, row.finished_at)
            self._connection.execute("REPLACE INTO done VALUES (?, ?, ?, ?, ?, ?)", values)
            self._connection.execute("DELETE FROM failed WHERE stage = ? AND frame = ?", (stage, frame))
        self._done[stage, frame] = row

    def forget_failures(self, stage: str, frames: Iterable[str]) -> None:
        """Removes noted failures of tasks that are about to be tried again or are no longer asked for."""
        with self._connection:
            rows = [(stage, frame) for frame in frames]
            self._connection.executemany("DELETE FROM failed WHERE stage = ? AND frame = ?", rows)

    def failures(self) -> list[Failure]:
        """All failures noted in this ledger."""
        return _failures(self._connection)

    def file_hash(self, path: Path) -> str:
        """Hash of a file's contents; remembered with its size and time, so that unchanged files are read once.

        "absent" for a file that is not there. Files changed within the last two seconds are read again next time:
        their time stamp cannot tell a second change.
        """
        try:
            status = os.stat(path)
        except OSError:
            return "absent"
        known = self._connection.execute(
            "SELECT hash FROM files WHERE path = ? AND size = ? AND mtime_ns = ?",
            (str(path), status.st_size, status.st_mtime_ns),
        ).fetchone()
        if known is not None:
            return str(known[0])
        try:
            value = content_hash(path.read_bytes())
        except OSError as error:
            return f"unreadable: {error.strerror}"
        if time.time() - status.st_mtime > 2:
            with self._connection:
                row = (str(path), status.st_size, status.st_mtime_ns, value)
                self._connection.execute("REPLACE INTO files VALUES (?, ?, ?, ?)", row)
        return value

    def mean_seconds(self, stage: str) -> float | None:
        """Mean measured seconds per frame of a stage, or None."""
        seconds = [row.seconds for (name, _), row in {**self._others, **self._done}.items() if name == stage]
        return sum(seconds) / len(seconds) if seconds else None


def all_failures(ledgers: Iterable[Path]) -> list[Failure]:
    """The failures of all shards of a run, sorted."""
    found: list[Failure] = []
    for path in ledgers:
        with closing(_open_to_read(path)) as connection:
            found += _failures(connection)
    return sorted(found, key=lambda failure: (failure.stage, failure.frame))


def _open_to_read(path: Path) -> sqlite3.Connection:
    # Not mode=ro: after a crash of its owner SQLite may have to roll the last transaction back before it can be read.
    return sqlite3.connect(f"{path.resolve().as_uri()}?mode=rw", uri=True, timeout=60)


def _read_others(paths: Iterable[Path]) -> dict[tuple[str, str], Row]:
    """The finished tasks of other shards, the latest of each."""
    found: dict[tuple[str, str], Row] = {}
    for path in paths:
        try:
            with closing(_open_to_read(path)) as connection:
                for task, row in _rows(connection).items():
                    if task not in found or found[task].finished_at < row.finished_at:
                        found[task] = row
        except sqlite3.DatabaseError as error:
            raise UsageError(f"{path}: {error}; {_hint(error)}") from None
    return found


def _rows(connection: sqlite3.Connection) -> dict[tuple[str, str], Row]:
    rows: Mapping[tuple[str, str], Row] = {
        (stage, frame): Row(key, {name: Written(*file) for name, file in json.loads(written).items()}, seconds, at)
        for stage, frame, key, written, seconds, at in connection.execute("SELECT * FROM done")
    }
    return dict(rows)


def _failures(connection: sqlite3.Connection) -> list[Failure]:
    return [Failure(**json.loads(text)) for (text,) in connection.execute("SELECT failure FROM failed")]


def _hint(error: sqlite3.DatabaseError) -> str:
    if isinstance(error, sqlite3.OperationalError):
        return "is the folder writable and the disk not full?"
    return "the ledger is damaged: remove it; finished frames will be computed again"
