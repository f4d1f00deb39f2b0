"""What a request for tables comes to: the runs, which of them are done, time and disk for the rest."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.experiments.intervals import Verdict, judge
from pipeline.experiments.runs import (
    UNSEEDED,
    Outcome,
    Run,
    available,
    budget_of,
    do_run,
    kind_module,
    plan_run,
    read_result,
)
from pipeline.experiments.tables import Recipe, Table

Changes = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Order:
    """What was asked for.

    seeds    how many, 0, 1, ...
    changes  of the budget, per kind of recipe ("completion": {"steps": 100}), from the configuration
    """

    tables: tuple[Table, ...]
    out: Path
    budget: str
    seeds: int
    data: Path | None = None
    changes: Changes | None = None


@dataclass(frozen=True)
class Plan:
    """Runs per table and row label, one per seed; runs of several tables are the same objects' equals."""

    order: Order
    runs: dict[str, dict[str, list[Run]]]

    def all_runs(self) -> list[Run]:
        """Every run once, in the order of tables and rows, all seeds of a row together."""
        found: dict[str, Run] = {}
        for rows in self.runs.values():
            for runs in rows.values():
                for run in runs:
                    found.setdefault(run.key, run)
        return list(found.values())

    def open_runs(self) -> list[Run]:
        """Runs without a result."""
        return [run for run in self.all_runs() if read_result(run, self.order.out) is None]


def make_plan(order: Order) -> Plan:
    """The runs of an order. Rows of kinds that this installation cannot compute have none."""
    made: dict[str, dict[str, list[Run]]] = {}
    for table in order.tables:
        rows = made.setdefault(table.name, {})
        for row in table.rows:
            if row.recipe is not None and available(row.recipe.kind):
                rows[row.label] = runs_of(row.recipe, order)
    return Plan(order, made)


def runs_of(recipe: Recipe, order: Order) -> list[Run]:
    """One run per seed; one in all where no seed matters."""
    budget = budget_of(recipe.kind, order.budget, order.changes)
    seeds = 1 if recipe.kind in UNSEEDED else order.seeds
    return [plan_run(recipe, budget, order.data, seed) for seed in range(seeds)]


@dataclass(frozen=True)
class Estimate:
    """Of what is left to do: seconds on one core, bytes."""

    runs: int
    seconds: float
    bytes: float


def estimate_cost(runs: Sequence[Run]) -> Estimate:
    """Time and disk of these runs; what is made once per experiment folder counts once."""
    seconds, size = 0.0, 0.0
    shared: dict[str, tuple[float, float]] = {}
    once: dict[str, float] = {}
    for run in runs:
        cost = kind_module(run.recipe.kind).cost(run.recipe, run.budget)
        seconds, size = seconds + cost.seconds, size + cost.bytes
        before = shared.get(run.recipe.kind, (0.0, 0.0))
        shared[run.recipe.kind] = (max(before[0], cost.data_seconds), max(before[1], cost.data_bytes))
        once |= cost.shared
    seconds += sum(pair[0] for pair in shared.values()) + sum(once.values())
    return Estimate(len(runs), seconds, size + sum(pair[1] for pair in shared.values()))


def carry_out(plan: Plan, say: Callable[[str], None] = print) -> None:
    """Does every run that has no result; a killed one continues from its own state."""
    left = plan.open_runs()
    for number, run in enumerate(left, start=1):
        settings = " ".join(f"{name}={value}" for name, value in run.recipe.settings.items())
        say(f"[{number}/{len(left)}] {run.recipe.kind} seed {run.seed}: {settings}")
        do_run(run, plan.order.out, plan.order.data, say)


@dataclass(frozen=True)
class TableResult:
    """A table with what was found: outcomes per row label, one per seed, a verdict per claim, the runs' folders."""

    table: Table
    outcomes: dict[str, list[Outcome]]
    verdicts: list[Verdict]
    folders: dict[str, list[Path]] = field(default_factory=dict)


def gather(plan: Plan, table: Table) -> TableResult:
    """The results of a table: of every row the seeds that are finished, up to the first that is not."""
    outcomes: dict[str, list[Outcome]] = {}
    for label, runs in plan.runs[table.name].items():
        for run in runs:
            outcome = read_result(run, plan.order.out)
            if outcome is None:
                break
            outcomes.setdefault(label, []).append(outcome)
    folders = {label: [run.folder(plan.order.out) for run in runs] for label, runs in plan.runs[table.name].items()}
    return TableResult(table, outcomes, judge(table, outcomes), folders)
