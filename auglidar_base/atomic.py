"""Files that appear complete or not at all: write beside the target, flush to the disk, rename over it."""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

TEMPORARY_PREFIX = ".writing-"


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path to write to; when the block ends well, what was written there becomes `path` in one step.

    The folder is made when it does not exist. A block that raises leaves `path` as it was and nothing behind; a killed
    process leaves a file that `remove_leftovers` knows. Raises OSError when the disk is full or not writable.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.parent / f"{TEMPORARY_PREFIX}{os.getpid()}-{secrets.token_hex(4)}"
    try:
        yield temporary
        with open(temporary, "r+b") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_bytes(path: Path, data: bytes) -> None:
    """Writes `data` to `path` atomically (see `replacing`)."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """`write_bytes` for UTF-8 text; what stands for bytes of a file name that is no text is written as \\udcf6."""
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def remove_leftovers(folder: Path) -> int:
    """Removes temporary files that a killed run left under `folder` more than an hour ago; returns how many.

    The hour keeps the files of another process that is writing into the same run at this moment.
    """
    old = time.time() - 3600
    removed = 0
    for path in folder.rglob(TEMPORARY_PREFIX + "*"):
        if path.is_file() and path.stat().st_mtime < old:
            path.unlink(missing_ok=True)
            removed += 1
    return removed
