"""Files of a data set as bytes and text: regular files of a sane size, and nothing outside the folder the user gave."""

from __future__ import annotations

import stat
from pathlib import Path

from detection.text import decode_text
from pipeline.base.errors import DataError

# Above any frame of the field (a KITTI frame has 2 MB); the size is looked at before anything is read.
MAX_FILE_BYTES = 512 * 1024 * 1024
# A label or calibration file has a few kilobytes.
MAX_TEXT_BYTES = 16 * 1024 * 1024


def read_file(path: Path, what: str, limit: int = MAX_FILE_BYTES) -> bytes:
    """The bytes of a regular file of at most `limit` bytes. Raises DataError that names `what` was expected."""
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise DataError(path, what, "a folder")
        if not stat.S_ISREG(status.st_mode):
            # Reading a named pipe would wait for ever.
            raise DataError(path, what, "a device or pipe")
        if status.st_size > limit:
            raise DataError(path, what, f"a file of {_size(status.st_size)}")
        return path.read_bytes()
    except FileNotFoundError:
        raise DataError(path, what, "no such file") from None
    except PermissionError:
        raise DataError(path, what, "a file that may not be read", "check its permissions") from None
    except OSError as error:
        raise DataError(path, what, f"a file that cannot be read ({error.strerror})") from None


def _size(size: int) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"


def read_bytes(path: Path, what: str) -> bytes:
    """`read_file`, which may not be empty."""
    data = read_file(path, what)
    if not data:
        raise DataError(path, what, "an empty file", "was the disk full when it was written?")
    return data


def read_text(path: Path, what: str) -> str:
    """A text file of at most 16 MB, which may be empty: UTF-8, or UTF-16 as PowerShell writes it; no marks are left.

    Raises DataError that names `what` was expected.
    """
    data = read_file(path, what, MAX_TEXT_BYTES)
    try:
        return decode_text(data)
    except ValueError as error:
        raise DataError(path, what, str(error)) from None


def check_inside(path: Path, root: Path) -> None:
    """Raises DataError when `path` is a link that leads out of its own folder and out of `root`.

    Folders may be links, since the user laid them; a file of a data set may not point at any file of the machine.
    """
    if not path.is_symlink():
        return
    try:
        target = path.resolve(strict=True)
    except (OSError, RuntimeError):
        return  # Broken or circular: reading it says so.
    if not any(target.is_relative_to(folder.resolve()) for folder in (path.parent, root)):
        raise DataError(path, f"a file below {root}", f"a link out of it, to {target}", "copy the file there")
