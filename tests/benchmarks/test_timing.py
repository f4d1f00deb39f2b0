"""The paired timing that all benchmarks rest on."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from benchmarks.timing import Comparison, Timing, compare, format_table, thread_counts, write_table


def test_ours_and_peers_take_turns() -> None:
    calls: list[str] = []
    runs = {name: (lambda name=name: calls.append(name)) for name in ("a", "b")}
    comparison = compare("turns", lambda: calls.append("o"), runs, repeats=3)
    # One run of each to warm up, then forwards, backwards, forwards.
    assert calls == [*"oab", *"oab", *"bao", *"oab"]
    assert [len(timing.seconds) for timing in (comparison.ours, *comparison.peers)] == [3, 3, 3]
    assert comparison.checks == {}


def test_ratio_is_above_one_when_we_are_faster() -> None:
    comparison = compare("sleep", lambda: None, {"slow": lambda: time.sleep(0.002)}, repeats=3)
    assert comparison.ratio("slow") > 1
    assert min(comparison.peers[0].seconds) >= 0.002


def test_results_are_checked_against_every_peer() -> None:
    comparison = compare("sum", lambda: 3, {"right": lambda: 3, "wrong": lambda: 4}, 1, lambda a, b: a == b)
    assert comparison.checks == {"right": True, "wrong": False}
    assert "DISAGREE" in format_table([comparison])
    assert "right" in str(comparison)


def test_table_holds_medians_spread_ratio_and_threads(tmp_path: Path) -> None:
    row = Comparison(
        "case", Timing("ours", (0.002, 0.001, 0.004)), (Timing("peer", (0.005, 0.006)),), {"peer": True}, {"cpus": 2}
    )
    alone = Comparison("alone", Timing("ours", (1.0,)), (), {}, {"cpus": 2})
    path = write_table([row, alone], tmp_path / "deep" / "table.md")
    text = path.read_text(encoding="utf-8")
    assert "| case | 2 ms [1-4] | peer | 5.5 ms [5-6] | 2.75 | agree | cpus 2 |" in text
    assert "| alone | 1,000 ms [1,000-1,000] | - |" in text


def test_no_repeats_are_refused() -> None:
    with pytest.raises(ValueError, match="repeats: expected at least 1, got 0"):
        compare("none", lambda: None, {}, 0)


def test_thread_counts_name_the_cpus() -> None:
    assert thread_counts()["cpus"] >= 1
