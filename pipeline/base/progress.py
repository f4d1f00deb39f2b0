"""Progress for people at a terminal (bars with time left) and for log files (a plain line now and then)."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

LINE_EVERY_SECONDS = 15.0


@dataclass
class Counter:
    """Called once per finished frame."""

    advance: Callable[[], None]
    say: Callable[[str], None]


@contextmanager
def progress(title: str, total: int) -> Iterator[Counter]:
    """Progress of `total` frames: a bar on a terminal, lines otherwise; both on standard error."""
    with (_bar if sys.stderr.isatty() else _lines)(title, total) as counter:
        yield counter


@contextmanager
def _bar(title: str, total: int) -> Iterator[Counter]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description:<9}"),
        BarColumn(bar_width=32),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as bars:
        task = bars.add_task(title, total=total)
        yield Counter(lambda: bars.advance(task), lambda text: bars.console.print(text, markup=False, highlight=False))


@contextmanager
def _lines(title: str, total: int) -> Iterator[Counter]:
    start = first = last = time.monotonic()
    done = 0

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    def advance() -> None:
        nonlocal done, first, last
        done += 1
        now = time.monotonic()
        if done == 1:  # it also compiled kernels and loaded weights, which no later frame does
            first = last = now
        elif now - last >= LINE_EVERY_SECONDS and done < total:
            last = now
            left = (now - first) / (done - 1) * (total - done)
            say(f"{title}: {done} of {total} frames, about {duration(left)} left")

    yield Counter(advance, say)
    if done:
        say(f"{title}: {done} of {total} frames in {duration(time.monotonic() - start)}")


def duration(seconds: float) -> str:
    """12.3 s, 4 min 05 s, 3 h 20 min."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"
