"""The ledger: one SQLite file per shard with a row per finished (stage, frame), and the failures.

SQLite gives durability: a row is either there after a power loss or it is not, and the files it names were flushed
before it was written. Only the process that owns a shard writes its ledger; every process reads all of them.
"""

from __future__ import annotations

import errno
import json
import os
import sqlite3
import stat
import time
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from pipeline.base.errors import UsageError
from pipeline.run_folder.frame_outputs import Written, file_content_hash
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

# The largest weight files have a few gigabytes.
_MAX_HASHED_BYTES = 64 * 10**9


@dataclass(frozen=True)
class Row:
    """A finished task: what it depended on (`key`), what it wrote, how long it took."""

    key: str
    written: dict[str, Written]
    seconds: float
    finished_at: float


class Ledger:
    """The ledger of this process, and the ledgers of the run's other shards to read.

    Rows are looked up in the files when they are asked for: memory does not grow with the number of frames.
    """

    def __init__(self, path: Path, others: Iterable[Path] = ()) -> None:
        """Raises UsageError when the folder cannot be written or a ledger is damaged."""
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{path.parent}: cannot be written: {error.strerror}") from None
        self._connection = _opened(path, f"file:{quote(str(path.resolve()))}")
        self._readers = [self._connection]
        # Not mode=ro: after a crash of its owner SQLite may have to roll back the last transaction before reading.
        self._readers += [
            _opened(other, f"file:{quote(str(other.resolve()))}?mode=rw") for other in others if other != path
        ]

    def close(self) -> None:
        """Closes the files."""
        for connection in self._readers:
            connection.close()

    def row(self, stage: str, frame: str) -> Row | None:
        """The last time this task was finished, by any shard."""
        query = "SELECT key, written, seconds, finished_at FROM done WHERE stage = ? AND frame = ?"
        with _explained(self.path):
            found = [row for reader in self._readers for row in reader.execute(query, (stage, frame))]
            if not found:
                return None
            key, written, seconds, finished_at = max(found, key=lambda row: row[3])
            files = {str(name): Written(int(size), str(value)) for name, (size, value) in json.loads(written).items()}
            return Row(key, files, float(seconds), float(finished_at))

    def record(self, outcome: Outcome, key: str) -> None:
        """Writes what became of a task; durable when the call returns."""
        stage, frame = outcome.task.stage, outcome.task.frame
        with _explained(self.path), self._connection:
            if outcome.failure is not None:
                text = json.dumps(outcome.failure.as_dict())
                self._connection.execute("REPLACE INTO failed VALUES (?, ?, ?)", (stage, frame, text))
                return
            written = json.dumps({name: [file.size, file.hash] for name, file in outcome.written.items()})
            values = (stage, frame, key, written, outcome.seconds, time.time())
            self._connection.execute("REPLACE INTO done VALUES (?, ?, ?, ?, ?, ?)", values)
            self._connection.execute("DELETE FROM failed WHERE stage = ? AND frame = ?", (stage, frame))

    def forget_failures(self, stage: str, frames: Iterable[str]) -> None:
        """Removes noted failures of tasks that are about to be tried again or are no longer asked for."""
        with _explained(self.path), self._connection:
            rows = [(stage, frame) for frame in frames]
            self._connection.executemany("DELETE FROM failed WHERE stage = ? AND frame = ?", rows)

    def failures(self) -> list[Failure]:
        """All failures noted in this ledger."""
        with _explained(self.path):
            return _failures(self._connection)

    def file_hash(self, path: Path) -> str:
        """Hash of a file's contents; remembered with its size and time, so that unchanged files are read once.

        "absent" for a file that is not there. Files changed within the last two seconds are read again next time:
        their time stamp cannot tell a second change.
        """
        try:
            status = os.stat(path)
        except OSError as error:
            return "absent" if error.errno == errno.ENOENT else f"unreadable: {error.strerror}"
        if not stat.S_ISREG(status.st_mode) or status.st_size > _MAX_HASHED_BYTES:
            # A pipe would wait for ever, and no reader takes a file of this size: the key need not tell them apart.
            return f"not read: {status.st_mode} {status.st_size} {status.st_mtime_ns}"
        with _explained(self.path):
            known = self._connection.execute(
                "SELECT hash FROM files WHERE path = ? AND size = ? AND mtime_ns = ?",
                (str(path), status.st_size, status.st_mtime_ns),
            ).fetchone()
        if known is not None:
            return str(known[0])
        try:
            value = file_content_hash(path)
        except OSError as error:
            return f"unreadable: {error.strerror}"
        if time.time() - status.st_mtime > 2:
            with _explained(self.path), self._connection:
                row = (str(path), status.st_size, status.st_mtime_ns, value)
                self._connection.execute("REPLACE INTO files VALUES (?, ?, ?, ?)", row)
        return value

    def mean_seconds(self, stage: str) -> float | None:
        """Mean measured seconds per frame of a stage over all shards, or None."""
        query = "SELECT COUNT(*), TOTAL(seconds) FROM done WHERE stage = ?"
        with _explained(self.path):
            found = [row for reader in self._readers for row in reader.execute(query, (stage,))]
        count = sum(row[0] for row in found)
        return sum(row[1] for row in found) / count if count else None


def all_failures(ledgers: Iterable[Path]) -> list[Failure]:
    """The failures of all shards of a run, sorted."""
    found: list[Failure] = []
    for path in ledgers:
        with closing(_opened(path, f"file:{quote(str(path.resolve()))}?mode=rw")) as connection, _explained(path):
            found += _failures(connection)
    return sorted(found, key=lambda failure: (failure.stage, failure.frame))


def _opened(path: Path, uri: str) -> sqlite3.Connection:
    """A connection to a ledger with its tables. Raises UsageError when it cannot be used."""
    with _explained(path):
        connection = sqlite3.connect(uri, uri=True, timeout=60)
        try:
            connection.execute("PRAGMA synchronous = FULL")
            connection.executescript(_SCHEMA)
        except BaseException:
            connection.close()
            raise
    return connection


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Trouble with a ledger as a UsageError that says what to do."""
    try:
        yield
    except (sqlite3.DatabaseError, ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        # The latter kinds: rows that another program wrote, or that damage changed.
        raise UsageError(f"{path}: {error}; {_hint(error)}") from None


def _failures(connection: sqlite3.Connection) -> list[Failure]:
    return [Failure(**json.loads(text)) for (text,) in connection.execute("SELECT failure FROM failed")]


def _hint(error: Exception) -> str:
    if isinstance(error, sqlite3.OperationalError):
        return "is the folder writable and the disk not full?"
    return "the ledger is damaged: remove it; finished frames will be computed again"
