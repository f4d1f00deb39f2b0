"""What one frame may take (`limits:` of the configuration): the size of its files, and memory."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.base.errors import DataError

# What PyTorch, OpenCV and Numba say instead of MemoryError.
_SAID = re.compile(r"not enough memory|can't allocate memory|Insufficient memory|OutOfMemoryError|bad_alloc", re.I)


def check_size(path: Path, most_mb: float) -> None:
    """Raises DataError for a larger file, before it is read. A file that is not there is left to its reader."""
    size = path.stat().st_size / 1e6 if path.is_file() else 0.0
    # 512 stands for what the readers take at most, which is counted in binary.
    if size > most_mb * (1.048576 if most_mb == 512 else 1.0):
        raise DataError(path, f"a file of at most {most_mb:g} MB (limits.file_mb)", f"{size:,.1f} MB")


@contextmanager
def bounded_memory(gigabytes: float | None) -> Iterator[None]:
    """MemoryError where the block takes more than this beside what the process has (Linux; elsewhere no bound)."""
    used = _data_bytes() if gigabytes is not None else None
    if gigabytes is None or used is None:
        yield
        return
    import resource

    before = resource.getrlimit(resource.RLIMIT_DATA)
    soft = int(used + gigabytes * 1e9)
    resource.setrlimit(resource.RLIMIT_DATA, (soft if before[1] < 0 else min(soft, before[1]), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def is_out_of_memory(error: BaseException) -> bool:
    """True for MemoryError and what libraries raise in its place."""
    return isinstance(error, MemoryError) or (isinstance(error, Exception) and bool(_SAID.search(str(error)[:500])))


def _data_bytes() -> int | None:
    """Private memory of this process as RLIMIT_DATA counts it, or None where that is not told."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    except OSError:
        return None
    found = re.search(r"^VmData:\s+(\d+) kB", status, re.M)
    return int(found.group(1)) * 1024 if found else None
