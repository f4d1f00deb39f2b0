"""Configuration of an experiment (configs/experiments/*.yaml): tables, budget, and changes of the budget."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.base.errors import UsageError
from pipeline.base.settings import nearest_name
from pipeline.base.yaml_files import read_yaml
from pipeline.experiments.further_rows import FurtherRow, read_rows
from pipeline.experiments.runs import BUDGET_NAMES, KINDS


@dataclass(frozen=True)
class ExperimentConfig:
    """What a file asks for; see `plan.Order`."""

    wanted: list[tuple[str, str]]
    budget: str
    seeds: int
    changes: Mapping[str, Mapping[str, Any]]
    rows: tuple[FurtherRow, ...] = ()


def read_config(path: Path) -> ExperimentConfig:
    """A file of configs/experiments. UsageError in one line for what is wrong in it.

    Keys: table and figure (a number or a list of them, as text), budget, seeds, rows (see `further_rows`), and a
    section per kind of run whose keys replace those of its budget.
    """
    tree = read_yaml(path)
    known = ("table", "figure", "budget", "seeds", "rows", *KINDS)
    for key in tree:
        if key not in known:
            raise UsageError(f"{path}: unknown key {key!r}; {nearest_name(str(key), known)}")
    budget, seeds = tree.get("budget", "small"), tree.get("seeds", 3)
    if budget not in BUDGET_NAMES:
        raise UsageError(f"{path}: budget: {nearest_name(str(budget), BUDGET_NAMES)}, got {budget!r}")
    if not isinstance(seeds, int) or seeds < 1:
        raise UsageError(f"{path}: seeds: expected 1 or more, got {seeds!r}")
    wanted = [(kind, number) for kind in ("table", "figure") for number in _numbers(tree, kind, path)]
    changes = {kind: _section(tree, kind, path) for kind in KINDS}
    return ExperimentConfig(wanted, budget, seeds, changes, read_rows(tree.get("rows", []), str(path)))


def _numbers(tree: Mapping[str, Any], kind: str, path: Path) -> list[str]:
    """Numbers are text: YAML reads 4.10 as 4.1."""
    given = tree.get(kind, [])
    numbers = given if isinstance(given, list) else [given]
    for number in numbers:
        if not isinstance(number, str):
            raise UsageError(f'{path}: {kind}: put the number in quotes ("4.10"), got {number!r}')
    return numbers


def _section(tree: Mapping[str, Any], kind: str, path: Path) -> Mapping[str, Any]:
    section = tree.get(kind) or {}
    if not isinstance(section, Mapping):
        raise UsageError(f"{path}: {kind}: expected keys of the budget with values, got {section!r}")
    return section
