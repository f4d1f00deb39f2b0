"""One policy for SIGINT and SIGTERM, whichever stage or verb is at work.

Frames in hand are finished where that is quick (`stop_on_signals`, around the frame stages). Everywhere else both
signals raise KeyboardInterrupt (`sigterm_as_interrupt`, around the whole program): pools are ended, half-written files
removed. A second signal ends the program at once. Child processes leave both signals to their parent and end with it
(`auglidar_base.children`). The exit code is 128 + the signal's number: 130 or 143.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Terminated(KeyboardInterrupt):
    """SIGTERM, raised where Ctrl-C would be."""


@contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """SIGTERM raises `Terminated` while the block runs (main thread only; elsewhere nothing changes)."""

    def on_signal(number: int, _: FrameType | None) -> None:
        signal.signal(number, signal.SIG_DFL)
        raise Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, on_signal)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class StopRequest:
    """Why the run should end early, or nothing."""

    def __init__(self) -> None:
        self.reason = ""
        self.signal_number = 0

    def __call__(self) -> bool:
        """True once a stop is asked for."""
        return bool(self.reason)

    def ask(self, reason: str, signal_number: int = 0) -> None:
        """Asks for a stop; the first reason stays."""
        if not self.reason:
            self.reason, self.signal_number = reason, signal_number


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """A StopRequest that SIGINT and SIGTERM set while the block runs (main thread only; others catch nothing)."""
    request = StopRequest()

    def on_signal(number: int, _: FrameType | None) -> None:
        if request():
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        request.ask(f"stopped by {signal.Signals(number).name}", number)

    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
