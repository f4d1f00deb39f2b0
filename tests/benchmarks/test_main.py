"""`python -m benchmarks`: sections of parts, and the page that is made of them."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path

from benchmarks.__main__ import BASELINE, PARTS, Part, agreement, kind_of_machine, read_baselines, results, run_part
from benchmarks.record import Measure


def test_every_part_is_a_module_of_its_own() -> None:
    assert all(find_spec(f"benchmarks.{part.command[0]}") for part in PARTS)


def test_a_part_that_fails_says_so_in_its_section(tmp_path: Path) -> None:
    section, measures, curves = run_part(Part("Nothing", ("absent",), ()), False, tmp_path)
    assert section.startswith("## Nothing\n\n`python -m benchmarks.absent`")
    assert "ended with code 1" in section
    assert (measures, curves) == ([], [])


def test_the_page_begins_with_targets_and_what_got_worse() -> None:
    found = [Measure("four steps, nearest", 0.01, "s", {"SciPy": 0.06}, True)]
    page = results("a machine", found, ["a: 1.00, was 2.00"], ["b"], ["## Part\n"])
    assert "| CLOUD | four steps, nearest | 10 ms | SciPy: 60 ms | 6.00 | ratio 5 | yes |" in page
    assert "- a: 1.00, was 2.00" in page
    assert "- b: **results disagree**" in page
    assert page.index("## Targets") < page.index("## Part")


def test_a_baseline_belongs_to_a_kind_of_machine(tmp_path: Path) -> None:
    assert kind_of_machine() == kind_of_machine()
    assert f", {os.cpu_count()} cores, " in kind_of_machine()
    assert agreement("a Pentium, 1 cores, no AVX", known=False).startswith("No baseline of this kind of machine (a Pen")
    assert read_baselines(tmp_path / "none.json") == {}
    assert all(all(ratio > 0 for ratio in kept.values()) for kept in read_baselines(BASELINE).values())
