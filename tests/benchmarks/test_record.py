"""Targets, baseline and figure of `python -m benchmarks`, on figures worked out by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.figures import draw
from benchmarks.record import Curve, Measure, got_worse, load, ratios, save, shown
from benchmarks.targets import Target, summary

TIME = Measure("a step", 0.002, "s", {"slow": 0.01, "slower": 0.03}, True)
RATE = Measure("frames", 90.0, "frames/min", {"1 worker": 50.0})


def test_ratio_says_how_many_times_better_ours_is() -> None:
    assert (TIME.ratio("slow"), TIME.ratio("slower"), TIME.best_peer) == (5.0, 15.0, "slow")
    assert RATE.ratio("1 worker") == pytest.approx(1.8)


def test_a_target_is_met_missed_or_undecided() -> None:
    assert Target("A", "a step", 5.0).met(TIME) is True
    assert Target("A", "a step", 5.1).met(TIME) is False
    assert Target("A", "a step", 5.1, "slower").met(TIME) is True
    assert Target("A", "a step", 0.003, "").met(TIME) is True
    assert Target("B", "frames", 100, "").met(RATE) is False
    assert Target("A", "a step", 1.0, "absent").met(TIME) is None


def test_a_fast_result_that_is_wrong_meets_nothing() -> None:
    wrong = Measure("a step", 0.002, "s", {"slow": 0.01}, False)
    assert Target("A", "a step", 1.0).met(wrong) is False


def test_summary_has_a_row_per_target_also_without_a_measure() -> None:
    text = summary([TIME], (Target("A", "a step", 5.5), Target("A", "not there", 1.0)))
    assert "| A | a step | 2 ms | slow: 10 ms | 5.00 | ratio 5.5 | **no** |" in text
    assert "| A | not there | not measured |" in text


def test_ratios_that_fell_by_more_than_a_fifth_are_told() -> None:
    before = {"a step | slow": 6.0, "a step | slower": 19.0, "gone | x": 1.0}
    assert got_worse(ratios([TIME]), before) == ["a step | slower: 15.00 times better than the peer, was 19.00"]


def test_slope_is_that_of_the_larger_sizes() -> None:
    sizes = (10.0, 100.0, 1000.0, 10000.0)
    assert Curve("n log n and a start", sizes, (5.0, 5.0, 50.0, 500.0)).slope == pytest.approx(1.0)
    assert Curve("quadratic", sizes, tuple(size**2 for size in sizes)).slope == pytest.approx(2.0)


def test_what_is_saved_is_loaded_and_drawn(tmp_path: Path) -> None:
    curve = Curve("points", (1.0, 10.0), (0.1, 1.0))
    save(tmp_path / "figures.json", [TIME, RATE], [curve])
    assert load(tmp_path / "figures.json") == ([TIME, RATE], [curve])
    assert load(tmp_path / "absent.json") == ([], [])
    assert draw([TIME, RATE], [curve], tmp_path / "picture.png").stat().st_size > 5000


def test_figures_are_shown_with_their_units() -> None:
    assert [shown(1.234, "s"), shown(0.0123, "s"), shown(188.4, "MB")] == ["1.23 s", "12.3 ms", "188 MB"]
