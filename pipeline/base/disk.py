"""Why a disk takes nothing more: no bytes, or no more files, which a look at the free bytes does not show."""

from __future__ import annotations

import os
from pathlib import Path


def no_more_files(folder: str | Path) -> str:
    """A line when the file system of `folder` has no inode left for a further file, else ""."""
    try:
        status = os.statvfs(_existing(Path(folder)))
    except (AttributeError, OSError):  # AttributeError: no such call on Windows
        return ""
    # File systems without a fixed number of inodes (btrfs, vfat) say 0 of 0.
    if status.f_files == 0 or status.f_favail > 0:
        return ""
    free = status.f_bavail * status.f_frsize / 1e9
    return f"no further file fits ({status.f_files:,} inodes are used up, {free:.2f} GB are free)"


def why_full(path: str | Path | None) -> str:
    """What to say of a file that did not fit."""
    return (path is not None and no_more_files(path)) or "the disk is full"


def _existing(path: Path) -> Path:
    return next(folder for folder in (path, *path.absolute().parents) if folder.exists())
