"""Standard output and error that may be closed, full, or unable to write a letter: the work goes on without them."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from typing import Any

# The reader went away (`... | head`), or there was never one (`>&-`): nobody misses what is not written.
_NOBODY_READS = (errno.EPIPE, errno.EBADF)


class PatientStream:
    """A text stream that drops what cannot be written, and notes why; everything else is the stream's own."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.trouble: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """All of the text, or nothing of it once there was trouble."""
        if self.trouble is None:
            try:
                self._stream.write(text)
            except OSError as error:
                self._give_up(error)
        return len(text)

    def flush(self) -> None:
        """As `write`."""
        if self.trouble is None:
            try:
                self._stream.flush()
            except OSError as error:
                self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self.trouble = error
        # What is still in the buffer goes to the null device, or Python fails once more at its end.
        with contextlib.suppress(OSError, ValueError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)
            self._stream.flush()


@contextlib.contextmanager
def patient_streams() -> Iterator[PatientStream]:
    """Both standard streams are patient while the block runs; gives standard output, to be asked for its trouble.

    Letters that the encoding lacks are written as \\xe4 or \\udcf6.
    """
    _fill_closed()
    before = sys.stdout, sys.stderr
    streams = [PatientStream(stream or open(os.devnull, "w", encoding="utf-8")) for stream in before]  # noqa: SIM115
    errors = [_replace_unknown_letters(stream) for stream in streams]
    sys.stdout, sys.stderr = streams
    try:
        yield streams[0]
    finally:
        for stream, way in zip(streams, errors):
            stream.flush()
            if way is not None:
                stream.reconfigure(errors=way)
        sys.stdout, sys.stderr = before


def lost_output(stream: PatientStream) -> str:
    """Why something that a reader waited for was not written, or ""."""
    trouble = stream.trouble
    if trouble is None or trouble.errno in _NOBODY_READS:
        return ""
    return f"standard output could not be written: {trouble.strerror}"


def _replace_unknown_letters(stream: PatientStream) -> str | None:
    """Sets it up and gives the way of before, None where the stream has no such thing."""
    way = getattr(stream, "errors", None)
    if way is None or not hasattr(stream, "reconfigure"):
        return None
    stream.reconfigure(errors="backslashreplace")
    return str(way)


def _fill_closed() -> None:
    """The next file that is opened would take the number of a closed stream, and get what is written to it."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
