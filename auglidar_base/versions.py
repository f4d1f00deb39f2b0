"""Which version wrote a file, and what is said about a training state of another one."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from auglidar_base.errors import CheckpointError


def own_version() -> str:
    """The installed version of this program; "unknown" in a checkout that is not installed."""
    try:
        return version("auglidar")
    except PackageNotFoundError:
        return "unknown"


def state_of_another_version(path: Path, found: str, wanted: str, written_by: str | None) -> CheckpointError:
    """What to raise for a training state in a format of another version; states of the first one do not name theirs."""
    by = written_by or "0.1.0 before its release"
    return CheckpointError(
        f"{path}: the state of a training begun with AugLiDAR {by} (format {found}, this version reads {wanted}); "
        "finish it there, or begin in another folder"
    )
