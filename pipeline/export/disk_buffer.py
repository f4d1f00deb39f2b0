"""Records that arrive frame by frame and are needed in one file at the end: kept on disk in between."""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from auglidar_base.atomic import replacing


class DiskBuffer:
    """Byte strings on disk, in the order they were added. Closed (and removed) with the object's `close`."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the buffer
        self.count = 0

    def add(self, data: bytes) -> None:
        """Adds one record."""
        self._file.write(struct.pack("<Q", len(data)))
        self._file.write(data)
        self.count += 1

    def __iter__(self) -> Iterator[bytes]:
        self._file.seek(0)
        for _ in range(self.count):
            (length,) = struct.unpack("<Q", self._file.read(8))
            yield self._file.read(length)

    def close(self) -> None:
        """Removes the records."""
        self._file.close()


def write_streamed(path: Path, write: Callable[[BinaryIO], None]) -> None:
    """A file that `write` fills piece by piece and that appears complete or not at all."""
    with replacing(path) as temporary, open(temporary, "xb") as file:
        write(file)
