"""The ledger: one SQLite file per shard with a row per finished (stage, frame), and the failures.

SQLite gives durability: a row is either there after a power loss or it is not, and the files it names were flushed
before it was written. Only the process that owns a shard writes its ledger; every process reads all of them. So a
failure that another shard noted is not removed there: it is noted here as settled, with the time it was noted.
"""

from __future__ import annotations

import errno
import json
import os
import stat
import time
from collections.abc import Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.errors import UsageError
from pipeline.run_folder.frame_outputs import Written, file_content_hash
from pipeline.runner.jobs import Failure, Outcome
from pipeline.runner.ledger_file import explained, opened

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

    def __init__(self, path: Path, others: Iterable[Path] = (), trust: bool = True) -> None:
        """trust  False: every file is read again, whatever is remembered of it

        Raises UsageError when the folder cannot be written or a ledger cannot be used.
        """
        self.path, self._trust = path, trust
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{path.parent}: cannot be written: {error.strerror}") from None
        with ExitStack() as opening:
            self._connection = opened(path, make=True)
            opening.callback(self._connection.close)
            self._others = []
            for other in others:
                if other != path:
                    self._others.append(opened(other, make=False))
                    opening.callback(self._others[-1].close)
            self._readers = [self._connection, *self._others]
            opening.pop_all()

    def close(self) -> None:
        """Closes the files."""
        for connection in self._readers:
            connection.close()

    def row(self, stage: str, frame: str) -> Row | None:
        """The last time this task was finished, by any shard."""
        query = "SELECT key, written, seconds, finished_at FROM done WHERE stage = ? AND frame = ?"
        with explained(self.path):
            found = [row for reader in self._readers for row in reader.execute(query, (stage, frame))]
            if not found:
                return None
            key, written, seconds, finished_at = max(found, key=lambda row: row[3])
            files = {str(name): Written(int(size), str(value)) for name, (size, value) in json.loads(written).items()}
            return Row(key, files, float(seconds), float(finished_at))

    def record(self, outcome: Outcome, key: str) -> None:
        """Writes what became of a task; durable when the call returns."""
        stage, frame = outcome.task.stage, outcome.task.frame
        with explained(self.path), self._connection:
            if outcome.failure is not None:
                text = json.dumps(outcome.failure.as_dict())
                self._connection.execute("REPLACE INTO failed VALUES (?, ?, ?, ?)", (stage, frame, text, time.time()))
                return
            written = json.dumps({name: [file.size, file.hash] for name, file in outcome.written.items()})
            values = (stage, frame, key, written, outcome.seconds, time.time())
            self._connection.execute("REPLACE INTO done VALUES (?, ?, ?, ?, ?, ?)", values)
            self._end_failure(stage, frame)

    def forget_failures(self, stage: str, frames: Iterable[str]) -> None:
        """Ends the noted failures, whoever noted them, of tasks that are about to be looked at or tried again."""
        with explained(self.path), self._connection:
            for frame in frames:
                self._end_failure(stage, frame)

    def _end_failure(self, stage: str, frame: str) -> None:
        """Within a transaction: the failure of a task is over here, and settled where another shard noted it."""
        self._connection.execute("DELETE FROM failed WHERE stage = ? AND frame = ?", (stage, frame))
        query = "SELECT failed_at FROM failed WHERE stage = ? AND frame = ?"
        times = [row[0] for other in self._others for row in other.execute(query, (stage, frame))]
        if times:
            self._connection.execute("REPLACE INTO settled VALUES (?, ?, ?)", (stage, frame, max(times)))

    def file_hash(self, path: Path) -> str:
        """Hash of a file's contents; remembered with its size, times and inode, so that unchanged files are read once.

        "absent" for a file that is not there. The time of change (ctime) cannot be set back, as that of the contents
        can. Files changed within the last two seconds are read again next time: their times cannot tell a second
        change.
        """
        try:
            status = os.stat(path)
        except OSError as error:
            return "absent" if error.errno == errno.ENOENT else f"unreadable: {error.strerror}"
        if not stat.S_ISREG(status.st_mode) or status.st_size > _MAX_HASHED_BYTES:
            # A pipe would wait for ever, and no reader takes a file of this size: the key need not tell them apart.
            return f"not read: {status.st_mode} {status.st_size} {status.st_mtime_ns}"
        place = os.fsencode(os.path.abspath(path)).decode("utf-8", "backslashreplace")
        signs = (status.st_size, status.st_mtime_ns, status.st_ctime_ns, _signed(status.st_ino))
        known = self._remembered(place, signs) if self._trust else None
        if known is not None:
            return known
        try:
            value = file_content_hash(path)
        except OSError as error:
            return f"unreadable: {error.strerror}"
        if time.time() - max(status.st_mtime, status.st_ctime) > 2:
            with explained(self.path), self._connection:
                self._connection.execute("REPLACE INTO files VALUES (?, ?, ?, ?, ?, ?)", (place, *signs, value))
        return value

    def _remembered(self, place: str, signs: tuple[int, ...]) -> str | None:
        query = "SELECT hash FROM files WHERE path = ? AND size = ? AND mtime_ns = ? AND ctime_ns = ? AND inode = ?"
        with explained(self.path):
            found = self._connection.execute(query, (place, *signs)).fetchone()
        return None if found is None else str(found[0])

    def mean_seconds(self, stage: str) -> float | None:
        """Mean measured seconds per frame of a stage over all shards, or None."""
        query = "SELECT COUNT(*), TOTAL(seconds) FROM done WHERE stage = ?"
        with explained(self.path):
            found = [row for reader in self._readers for row in reader.execute(query, (stage,))]
        count = sum(row[0] for row in found)
        return sum(row[1] for row in found) / count if count else None


def all_failures(ledgers: Iterable[Path]) -> list[Failure]:
    """The failures of all shards of a run that are not over, sorted."""
    noted: list[tuple[float, Failure]] = []
    settled: dict[tuple[str, str], float] = {}
    for path in ledgers:
        with closing(opened(path, make=False)) as connection, explained(path):
            rows = connection.execute("SELECT failure, failed_at FROM failed")
            noted += [(float(at), Failure(**json.loads(text))) for text, at in rows]
            for stage, frame, at in connection.execute("SELECT stage, frame, failed_at FROM settled"):
                settled[stage, frame] = max(float(at), settled.get((stage, frame), 0.0))
    found = [item for at, item in noted if at > settled.get((item.stage, item.frame), -1.0)]
    return sorted(found, key=lambda failure: (failure.stage, failure.frame))


def _signed(number: int) -> int:
    """An inode, which has 64 bits, as SQLite keeps numbers."""
    return number - 2**64 if number >= 2**63 else number
