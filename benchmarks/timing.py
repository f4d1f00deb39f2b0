"""Paired timing: ours and its peers take turns in one process, so that a busy machine slows all of them alike."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Timing:
    """Wall-clock seconds of one implementation over all repeats."""

    label: str
    seconds: tuple[float, ...]

    @property
    def median(self) -> float:
        return statistics.median(self.seconds)


@dataclass(frozen=True)
class Comparison:
    """One row of a table: ours against each peer.

    checks  peer label -> what `check` found (True: results agree); absent when no check was asked for
    """

    name: str
    ours: Timing
    peers: tuple[Timing, ...]
    checks: dict[str, bool]
    threads: dict[str, int]

    def ratio(self, peer: str) -> float:
        """Median of the peer over our median: above 1 we are faster."""
        return next(timing.median for timing in self.peers if timing.label == peer) / self.ours.median

    def __str__(self) -> str:
        parts = [f"{self.name}: ours {_milliseconds(self.ours)}"]
        for peer in self.peers:
            verdict = {True: ", agrees", False: ", DISAGREES", None: ""}[self.checks.get(peer.label)]
            parts.append(f"{peer.label} {_milliseconds(peer)} ({self.ratio(peer.label):.2f}x{verdict})")
        return " | ".join(parts)


def _milliseconds(timing: Timing) -> str:
    median, least, most = (
        three_digits(1e3 * value) for value in (timing.median, min(timing.seconds), max(timing.seconds))
    )
    return f"{median} ms [{least}-{most}]"


def three_digits(value: float) -> str:
    """Three digits, or all before the point: 0.0123, 12.3, 1,340."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def thread_counts() -> dict[str, int]:
    """Threads that the libraries may use in this process; torch is asked only when it is already imported."""
    import sys

    counts = {"cpus": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1}
    if "torch" in sys.modules:
        counts["torch"] = sys.modules["torch"].get_num_threads()
    if "OMP_NUM_THREADS" in os.environ:
        counts["OMP_NUM_THREADS"] = int(os.environ["OMP_NUM_THREADS"].split(",")[0])
    return counts


def compare(
    name: str,
    ours: Callable[[], Any],
    peers: dict[str, Callable[[], Any]],
    repeats: int = 11,
    check: Callable[[Any, Any], bool] | None = None,
) -> Comparison:
    """Run `ours` and every peer `repeats` times in turn and keep all times.

    One run of each beforehand (not timed) compiles, warms caches and feeds `check(our_result, peer_result)`.
    """
    if repeats < 1:
        raise ValueError(f"repeats: expected at least 1, got {repeats}")
    our_result = ours()
    checks = {}
    for label, peer in peers.items():
        peer_result = peer()
        if check is not None:
            checks[label] = bool(check(our_result, peer_result))

    runs = {"ours": ours, **peers}
    seconds: dict[str, list[float]] = {label: [] for label in runs}
    for repeat in range(repeats):
        # The order turns round, so that nobody always runs after the same neighbour's cache traffic.
        order = list(runs) if repeat % 2 == 0 else list(runs)[::-1]
        for label in order:
            start = time.perf_counter()
            runs[label]()
            seconds[label].append(time.perf_counter() - start)
    timings = [Timing(label, tuple(values)) for label, values in seconds.items()]
    return Comparison(name, timings[0], tuple(timings[1:]), checks, thread_counts())


def format_table(rows: Iterable[Comparison]) -> str:
    """Markdown table: medians, min-max spread, ratio to ours, agreement, threads."""
    rows = list(rows)
    lines = [
        f"Python {platform.python_version()}, {platform.machine()}; medians with [min-max] over alternating runs.",
        "",
        "| case | ours | peer | peer's time | peer / ours | results | threads |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        threads = ", ".join(f"{name} {count}" for name, count in row.threads.items())
        if not row.peers:
            lines.append(f"| {row.name} | {_milliseconds(row.ours)} | - | - | - | - | {threads} |")
        for peer in row.peers:
            verdict = {True: "agree", False: "DISAGREE", None: "not compared"}[row.checks.get(peer.label)]
            lines.append(
                f"| {row.name} | {_milliseconds(row.ours)} | {peer.label} | {_milliseconds(peer)} "
                f"| {row.ratio(peer.label):.2f} | {verdict} | {threads} |"
            )
    return "\n".join(lines) + "\n"


def write_table(rows: Iterable[Comparison], path: str | Path) -> Path:
    """Write `format_table(rows)` to a Markdown file (its folder is made) and return its path."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(format_table(rows), encoding="utf-8")
    return path
