"""Means with 95 % confidence intervals, and whether an ordering that the thesis claims holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.experiments.runs import Outcome
from pipeline.experiments.tables import HIGHER, Claim, Column, RankClaim, Row, Table

CONFIDENCE = 0.95
RESAMPLES = 2000
ONE_TRAINING = "paired bootstrap of two single trainings"
HOLDS, PERHAPS, FAILS, UNKNOWN = "holds", "undecided", "does not hold", "not run"


@dataclass(frozen=True)
class Estimate:
    """A mean with its spread.

    deviation  standard deviation over seeds (NaN for one seed)
    low, high  95 % interval; NaN when none can be made
    how        "t over N seeds", "bootstrap over N frames", "bootstrap of the run" or "none"
    """

    mean: float
    deviation: float
    low: float
    high: float
    how: str


def over_seeds(values: Sequence[float]) -> Estimate:
    """Mean, deviation and t interval of two or more values. ValueError for fewer."""
    from scipy.stats import t

    if len(values) < 2:
        raise ValueError(f"expected at least 2 values, got {len(values)}")
    numbers = np.asarray(values, np.float64)
    mean, deviation = float(numbers.mean()), float(numbers.std(ddof=1))
    half = float(t.ppf(0.5 + CONFIDENCE / 2, len(numbers) - 1)) * deviation / float(np.sqrt(len(numbers)))
    return Estimate(mean, deviation, mean - half, mean + half, f"t over {len(numbers)} seeds")


def over_frames(values: Sequence[float] | NDArray[np.float64]) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean over frames; NaN frames are left out. (NaN, NaN) for fewer than 2."""
    numbers = np.asarray(values, np.float64)
    numbers = numbers[np.isfinite(numbers)]
    if len(numbers) < 2:
        return float("nan"), float("nan")
    rng = np.random.default_rng(0)
    means = numbers[rng.integers(len(numbers), size=(RESAMPLES, len(numbers)))].mean(axis=1)
    low, high = np.percentile(means, [50 * (1 - CONFIDENCE), 50 * (1 + CONFIDENCE)])
    return float(low), float(high)


def value_of(outcome: Outcome, row: Row, column: Column) -> float:
    """A row's value of a column in one outcome; NaN when the run has no such number."""
    return outcome.numbers.get(number_name(row, column), float("nan"))


def number_name(row: Row, column: Column) -> str:
    """Name of a number in a run's result: "fused/mae_mm", or "mae_mm" for a row without a view."""
    return f"{row.view}/{column.key}" if row.view else column.key


def estimate(outcomes: Sequence[Outcome], row: Row, column: Column) -> Estimate | None:
    """Of a row's column over its outcomes, one per seed; None without outcomes or number."""
    values = [value_of(outcome, row, column) for outcome in outcomes]
    if not values or not np.isfinite(values).all():
        return None
    if len(values) > 1:
        return over_seeds(values)
    name, nan = number_name(row, column), float("nan")
    if name in outcomes[0].intervals:
        return Estimate(values[0], nan, *outcomes[0].intervals[name], "bootstrap of the run")
    frames = outcomes[0].frames.get(name, [])
    low, high = over_frames(frames)
    return Estimate(values[0], nan, low, high, f"bootstrap over {len(frames)} frames" if low == low else "none")


@dataclass(frozen=True)
class Verdict:
    """Whether a claim holds in our runs, and by which numbers."""

    text: str
    verdict: str
    evidence: str


def judge(table: Table, outcomes: Mapping[str, Sequence[Outcome]]) -> list[Verdict]:
    """Every claim of a table; outcomes by row label, one per seed in the same order of seeds."""
    return [
        _judge_order(claim, table, outcomes) if isinstance(claim, Claim) else _judge_ranks(claim, table, outcomes)
        for claim in table.claims
    ]


def _column_values(table: Table, label: str, key: str, outcomes: Mapping[str, Sequence[Outcome]]) -> list[float]:
    row, column = table.row(label), table.column(key)
    return [value_of(outcome, row, column) for outcome in outcomes.get(label, ())]


def margin(
    table: Table, key: str, better: str, worse: str, outcomes: Mapping[str, Sequence[Outcome]]
) -> Estimate | None:
    """By how much `better` beats `worse` (positive: it does), paired by seed, or by frame when there is one seed.

    Seeds that one of the two rows lacks are left out.
    """
    first, second = (_column_values(table, label, key, outcomes) for label in (better, worse))
    if not first or not second or not np.isfinite([*first, *second]).all():
        return None
    column = table.column(key)
    sign = 1.0 if column.better == HIGHER else -1.0
    differences = [sign * (a - b) for a, b in zip(first, second)]
    if len(differences) > 1:
        return over_seeds(differences)
    frames = [
        np.asarray(outcomes[label][0].frames.get(number_name(table.row(label), column), []), np.float64)
        for label in (better, worse)
    ]
    low, high = float("nan"), float("nan")
    draws = [outcomes[label][0].draws.get(number_name(table.row(label), column), []) for label in (better, worse)]
    if draws[0] and len(draws[0]) == len(draws[1]):
        paired = sign * (np.asarray(draws[0], np.float64) - np.asarray(draws[1], np.float64))
        low, high = np.percentile(paired, [50 * (1 - CONFIDENCE), 50 * (1 + CONFIDENCE)])
        recipe = table.row(better).recipe
        how = "exact" if recipe is not None and recipe.kind == "analysis" else ONE_TRAINING
        return Estimate(differences[0], float("nan"), float(low), float(high), how)
    if len(frames[0]) == len(frames[1]):
        low, high = over_frames(sign * (frames[0] - frames[1]))
    return Estimate(differences[0], float("nan"), low, high, "paired bootstrap over frames")


def _judge_order(claim: Claim, table: Table, outcomes: Mapping[str, Sequence[Outcome]]) -> Verdict:
    """The claim holds when each pair's interval is above 0, fails when one is below 0."""
    verdicts, lines = [], []
    column = table.column(claim.column)
    for better in claim.better:
        for worse in claim.worse:
            found = margin(table, claim.column, better, worse, outcomes)
            if found is None:
                return Verdict(claim.text, UNKNOWN, "")
            verdicts.append(_sign(found))
            interval = (
                f" [{found.low:+.{column.digits}f}, {found.high:+.{column.digits}f}]" if found.low == found.low else ""
            )
            only = " over test frames, one training each" if found.how == ONE_TRAINING else ""
            lines.append(f"{better} ahead of {worse} by {found.mean:+.{column.digits}f}{interval}{only}")
    worst = FAILS if FAILS in verdicts else PERHAPS if PERHAPS in verdicts else HOLDS
    return Verdict(claim.text, worst, "; ".join(lines))


def _sign(found: Estimate) -> str:
    if found.how == ONE_TRAINING:  # the scatter between trainings is not known
        return PERHAPS
    if found.low > 0:
        return HOLDS
    return FAILS if found.high < 0 else PERHAPS


def kendall_tau(first: Sequence[float] | NDArray[np.float64], second: Sequence[float] | NDArray[np.float64]) -> float:
    """Kendall's tau (b) of two lists of values: 1 when they rank alike, -1 when reversed."""
    from scipy.stats import kendalltau

    return float(kendalltau(first, second).statistic)


def _judge_ranks(claim: RankClaim, table: Table, outcomes: Mapping[str, Sequence[Outcome]]) -> Verdict:
    """Tau of the means over seeds, and the range of the seeds' own."""
    lists = [
        [_column_values(table, label, claim.column, outcomes) for label in side] for side in (claim.first, claim.second)
    ]
    seeds = min(len(values) for side in lists for values in side)
    first, second = (np.asarray([values[:seeds] for values in side]) for side in lists)
    if not seeds or not np.isfinite([first, second]).all():
        return Verdict(claim.text, UNKNOWN, "")
    tau = kendall_tau(first.mean(1), second.mean(1))
    own = [kendall_tau(first[:, seed], second[:, seed]) for seed in range(first.shape[1])]
    evidence = f"Kendall's tau of the means {tau:.2f}; per seed {', '.join(f'{value:.2f}' for value in own)}"
    alike = [value > 1 - 1e-9 for value in (tau, *own)]  # equal ranks give 0.9999999999999999
    if all(alike) or not any(alike):
        return Verdict(claim.text, HOLDS if alike[0] == claim.same else FAILS, evidence)
    return Verdict(claim.text, PERHAPS, evidence)
