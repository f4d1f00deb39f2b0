"""The file of a ledger: its tables, their version, and what is said when it cannot be used."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

from pipeline.base.disk import why_full
from pipeline.base.errors import UsageError

# 1 (or 0: not written down): hashes of files by path, size and time; failures without a time.
VERSION = 2
WAIT_SECONDS = 60.0

_COLUMNS = {
    "done": ("stage", "frame", "key", "written", "seconds", "finished_at"),
    "failed": ("stage", "frame", "failure", "failed_at"),
    "settled": ("stage", "frame", "failed_at"),
    "files": ("path", "size", "mtime_ns", "ctime_ns", "inode", "hash"),
}
_SCHEMA = """
CREATE TABLE IF NOT EXISTS done (
  stage TEXT NOT NULL, frame TEXT NOT NULL, key TEXT NOT NULL, written TEXT NOT NULL, seconds REAL NOT NULL,
  finished_at REAL NOT NULL, PRIMARY KEY (stage, frame));
CREATE TABLE IF NOT EXISTS failed (
  stage TEXT NOT NULL, frame TEXT NOT NULL, failure TEXT NOT NULL, failed_at REAL NOT NULL DEFAULT 0,
  PRIMARY KEY (stage, frame));
CREATE TABLE IF NOT EXISTS settled (
  stage TEXT NOT NULL, frame TEXT NOT NULL, failed_at REAL NOT NULL, PRIMARY KEY (stage, frame));
CREATE TABLE IF NOT EXISTS files (
  path TEXT PRIMARY KEY, size INTEGER NOT NULL, mtime_ns INTEGER NOT NULL, ctime_ns INTEGER NOT NULL,
  inode INTEGER NOT NULL, hash TEXT NOT NULL);
"""


def opened(path: Path, make: bool) -> sqlite3.Connection:
    """A connection to a ledger with the tables of today; `make`: the file too. UsageError when it cannot be used."""
    # Not mode=ro: after a crash of its owner SQLite may have to roll back the last transaction before reading.
    uri = f"file:{quote(os.fsencode(path.resolve()))}" + ("" if make else "?mode=rw")
    with explained(path):
        connection = sqlite3.connect(uri, uri=True, timeout=WAIT_SECONDS)
        try:
            connection.execute("PRAGMA synchronous = FULL")
            _bring_up_to_date(connection, path)
        except BaseException:
            connection.close()
            raise
    return connection


def _bring_up_to_date(connection: sqlite3.Connection, path: Path) -> None:
    """Makes the tables that are missing; tables of version 1 get their new columns and keep their rows."""
    if _version(connection) == VERSION and _lacking(connection) is None:
        return
    connection.execute("BEGIN IMMEDIATE")  # another process may be doing the same
    with connection:
        version = _version(connection)
        if version > VERSION:
            raise UsageError(
                f"{path}: a ledger of a newer program (its tables are version {version}, this one knows {VERSION}): "
                "use that program, or another --out"
            )
        if version < VERSION:
            if _columns(connection, "failed") == _COLUMNS["failed"][:3]:
                connection.execute("ALTER TABLE failed ADD COLUMN failed_at REAL NOT NULL DEFAULT 0")
            if "inode" not in _columns(connection, "files"):
                connection.execute("DROP TABLE IF EXISTS files")  # only saves reading files again
        for statement in filter(str.strip, _SCHEMA.split(";")):
            connection.execute(statement)
        connection.execute(f"PRAGMA user_version = {VERSION}")
    lacking = _lacking(connection)
    if lacking is not None:
        raise UsageError(
            f"{path}: its table {lacking!r} has other columns than a ledger's: another program changed it; "
            "remove the file; finished frames will be computed again"
        )


def _version(connection: sqlite3.Connection) -> int:
    return int(connection.execute("PRAGMA user_version").fetchone()[0])


def _columns(connection: sqlite3.Connection, table: str) -> tuple[str, ...]:
    return tuple(str(row[1]) for row in connection.execute(f"PRAGMA table_info({table})"))


def _lacking(connection: sqlite3.Connection) -> str | None:
    """The first table whose columns are not those of a ledger."""
    return next((name for name, columns in _COLUMNS.items() if _columns(connection, name) != columns), None)


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Trouble with a ledger as a UsageError that says what to do."""
    try:
        yield
    except (sqlite3.DatabaseError, ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        # The latter kinds: rows that another program wrote, or that damage changed.
        raise UsageError(f"{path}: {error}; {_hint(error, path)}") from None


def _hint(error: Exception, path: Path) -> str:
    text = str(error)
    if isinstance(error, sqlite3.OperationalError):
        if "locked" in text:
            return (
                f"another process held it for {WAIT_SECONDS:.0f} s: wait until that one has finished, or stop it, "
                "and give the same command again"
            )
        if "full" in text or why_full(path) != "the disk is full":
            return f"{why_full(path)}: make room and give the same command again"
        return "is the folder writable and the disk not full?"
    return "the ledger is damaged: remove it; finished frames will be computed again"
