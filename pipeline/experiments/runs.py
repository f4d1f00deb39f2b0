"""Runs: recipe, budget and seed become a folder OUT/runs/KEY with result.json; done once, shared by all tables."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from auglidar_base.atomic import remove_leftovers, write_text
from pipeline.base.errors import UsageError
from pipeline.base.settings import nearest_name, plain, with_changes
from pipeline.base.versions import made_with
from pipeline.experiments.tables import Recipe
from pipeline.run_folder.own_methods import Room, is_own, own_version

BUDGET_NAMES = ("smoke", "small", "paper")

# kind of recipe -> module with BUDGETS, data_identity, cost and run (see `Kind`)
KINDS: dict[str, str] = {
    "completion": "pipeline.experiments.completion_runs",
    "analysis": "pipeline.experiments.analysis_runs",
    "detection": "pipeline.experiments.detection_runs",
    "frustum": "pipeline.experiments.frustum_runs",
    "cloud": "pipeline.experiments.cloud_runs",
    "completer": "pipeline.experiments.bundled_runs",
    "selection": "pipeline.experiments.bundled_runs",
}


# Kinds whose runs depend on no seed: one run, whatever the number of seeds asked for.
UNSEEDED = ("cloud", "completer")


@dataclass(frozen=True)
class Outcome:
    """What a run found; every value finite or NaN.

    numbers    name -> value over all test frames
    frames     name -> value per test frame (NaN where a frame has none), for numbers that are means over frames:
               intervals of a single seed are made from them
    intervals  name -> (low, high), 95 %, for numbers that are no means over frames (AP): the run's own bootstrap
    draws      name -> value per resample of the test frames, the same resamples for every run on the same frames:
               differences of two single runs are judged by them
    """

    numbers: dict[str, float]
    frames: dict[str, list[float]] = field(default_factory=dict)
    intervals: dict[str, tuple[float, float]] = field(default_factory=dict)
    draws: dict[str, list[float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Cost:
    """Estimate for one run: seconds on one core, bytes on disk; `data` seconds are spent once per experiment folder.

    shared  further seconds that are spent once, by what is made
    """

    seconds: float
    bytes: float = 0.0
    data_seconds: float = 0.0
    data_bytes: float = 0.0
    shared: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Context:
    """Where and how one run is done.

    out     folder of the experiments; shared data goes to out/data
    folder  the run's own folder: training state is kept here, and continued after a kill
    data    data set of the user, or None for the synthetic world
    budget  the kind's budget, a frozen dataclass
    say     prints one line of progress
    """

    out: Path
    folder: Path
    data: Path | None
    budget: Any
    seed: int
    say: Callable[[str], None] = print


@runtime_checkable
class Divided(Protocol):
    """A budget of which a run needs a part, so that what other runs are given changes nothing about it."""

    def part_for(self, settings: Mapping[str, Any]) -> Any:
        """The budget of a run with these settings."""


class Kind(Protocol):
    """What a module in KINDS has.

    BUDGETS          a frozen dataclass for each of BUDGET_NAMES
    data_identity    plain values that say which data a run uses (part of its key)
    cost             estimate before anything is run
    run              does the work; called again after a kill, it continues from what is in context.folder
    """

    BUDGETS: Mapping[str, Any]

    def data_identity(self, data: Path | None, budget: Any) -> Any: ...

    def cost(self, recipe: Recipe, budget: Any) -> Cost: ...

    def run(self, recipe: Recipe, context: Context) -> Outcome: ...


def available(kind: str) -> bool:
    """True when this installation can compute recipes of this kind."""
    return kind in KINDS and importlib.util.find_spec(KINDS[kind]) is not None


def kind_module(kind: str) -> Kind:
    """The module of a kind. UsageError for an unknown one."""
    if not available(kind):
        raise UsageError(f"no runs of kind {kind!r}; {nearest_name(kind, [k for k in KINDS if available(k)])}")
    module: Any = importlib.import_module(KINDS[kind])
    return module


def budget_of(kind: str, name: str, changes: Mapping[str, Mapping[str, Any]] | None = None) -> Any:
    """The kind's budget `name` with the changes of the configuration's section of that kind."""
    budgets = kind_module(kind).BUDGETS
    if name not in budgets:
        raise UsageError(f"unknown budget {name!r}; {nearest_name(name, budgets)}")
    return with_changes(budgets[name], (changes or {}).get(kind, {}), kind)


@dataclass(frozen=True)
class Run:
    """One recipe with its budget and seed; `key` names its folder."""

    recipe: Recipe
    budget: Any
    seed: int
    key: str

    def folder(self, out: Path) -> Path:
        """OUT/runs/KEY."""
        return out / "runs" / self.key


def settings_of(budget: Any) -> dict[str, Any]:
    """A budget as plain values without its measured times ("seconds_..."), on which no result depends."""

    def untimed(value: Any) -> Any:
        if not isinstance(value, Mapping):
            return value
        return {name: untimed(inner) for name, inner in value.items() if not name.startswith("seconds_")}

    settings: dict[str, Any] = untimed(plain(budget))
    return settings


def plan_run(recipe: Recipe, budget: Any, data: Path | None, seed: int) -> Run:
    """The run of a recipe: its key is a hash of settings, budget, data and seed."""
    module = kind_module(recipe.kind)
    if isinstance(budget, Divided):
        budget = budget.part_for(recipe.settings)
    record = {
        "kind": recipe.kind,
        "settings": plain(recipe.settings),
        "budget": settings_of(budget),
        "data": module.data_identity(data, budget),
        "seed": seed,
    }
    own = own_versions(recipe.settings, record["budget"])
    if own:
        record["own"] = own
    digest = hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
    return Run(recipe, budget, seed, f"{recipe.kind}-{digest[:16]}")


def own_versions(settings: Mapping[str, Any], budget: Mapping[str, Any]) -> list[str]:
    """Versions of the classes of one's own that a recipe or its budget names: a changed source is another run.

    Raises UsageError for one that cannot be used, before anything is computed.
    """
    options = settings.get("options") or {}
    inputs = [settings.get("input") or {}, settings.get("test_input") or {}]
    named: list[tuple[Room, Any, Mapping[str, Any]]] = [
        ("completion", settings.get("completer"), options),
        ("completion", budget.get("completer"), {}),
        *(("completion", one.get("depth"), {}) for one in inputs),
        ("detection", settings.get("detector"), options),
    ]  # fmt: skip
    return [own_version(room, name, given) for room, name, given in named if name and is_own(room, str(name))]


def read_result(run: Run, out: Path) -> Outcome | None:
    """The outcome of a finished run, or None. UsageError when its file is damaged."""
    path = run.folder(out) / "result.json"
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return Outcome(
            {name: _number(value) for name, value in content["numbers"].items()},
            {name: [_number(value) for value in values] for name, values in content["frames"].items()},
            {name: (_number(low), _number(high)) for name, (low, high) in content["intervals"].items()},
            {name: [_number(value) for value in values] for name, values in content.get("draws", {}).items()},
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(f"{path}: not the result of a run ({error}); remove it and give the command again") from None


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _plain_number(value: float) -> float | None:
    """NaN has no place in JSON."""
    return None if math.isnan(value) else float(value)


def do_run(run: Run, out: Path, data: Path | None, say: Callable[[str], None] = print) -> Outcome:
    """The outcome of a run, computed unless it is there already.

    result.json appears when all is done, timing.json (seconds, versions) beside it; both atomically.
    """
    found = read_result(run, out)
    if found is not None:
        return found
    folder = run.folder(out)
    folder.mkdir(parents=True, exist_ok=True)
    remove_leftovers(folder)
    begin = time.monotonic()
    outcome = kind_module(run.recipe.kind).run(run.recipe, Context(out, folder, data, run.budget, run.seed, say))
    timing = {"seconds_of_last_start": round(time.monotonic() - begin, 1), "made_with": made_with()}
    write_text(folder / "timing.json", json.dumps(timing, indent=1) + "\n")
    record = {
        "kind": run.recipe.kind,
        "settings": plain(run.recipe.settings),
        "budget": settings_of(run.budget),
        "seed": run.seed,
        "numbers": {name: _plain_number(value) for name, value in sorted(outcome.numbers.items())},
        "frames": {name: [_plain_number(v) for v in values] for name, values in sorted(outcome.frames.items())},
        "intervals": {name: [_plain_number(v) for v in pair] for name, pair in sorted(outcome.intervals.items())},
        "draws": {name: [_plain_number(v) for v in values] for name, values in sorted(outcome.draws.items())},
    }
    write_text(folder / "result.json", json.dumps(record, indent=1) + "\n")
    return read_result(run, out) or outcome
