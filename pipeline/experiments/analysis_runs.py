"""Runs without a network: expected losses, the filter over a depth step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.errors import UsageError
from pipeline.experiments.runs import Context, Cost, Outcome
from pipeline.experiments.tables import Recipe


@dataclass(frozen=True)
class AnalysisBudget:
    """Nothing to choose: these computations are exact."""

    points: int = 5001


BUDGETS: Mapping[str, AnalysisBudget] = dict.fromkeys(("smoke", "small", "paper"), AnalysisBudget())


def data_identity(data: Path | None, budget: Any) -> Any:
    """They read no data."""
    return None


def cost(recipe: Recipe, budget: Any) -> Cost:
    """Next to nothing."""
    return Cost(seconds=0.1, bytes=1e3)


def run(recipe: Recipe, context: Context) -> Outcome:
    """Computes one analysis."""
    what = str(recipe.settings["what"])
    if what not in ANALYSES:
        raise UsageError(f"unknown analysis {what!r}; known: {', '.join(ANALYSES)}")
    numbers = ANALYSES[what](recipe, context)
    # Exact: every resample would give the same.
    return Outcome(numbers, draws={name: [value] for name, value in numbers.items()})


def _expected_loss(recipe: Recipe, context: Context) -> dict[str, float]:
    """Fig. 2.5 and 4.3: expectation half-way between two possible depths, on the nearer one, and where it is least."""
    from completion.analysis import expected_loss
    from completion.figures import loss_curves

    depths = [float(depth) for depth in recipe.settings["depths"]]
    probability = float(recipe.settings["probability"])
    loss = loss_curves(float(recipe.settings["gamma"]))[str(recipe.settings["loss"])]
    shares = (probability, 1 - probability)
    estimates = np.linspace(depths[0] - 2, depths[1] + 2, context.budget.points)
    expected = expected_loss(loss, estimates, depths, shares)
    return {
        "between_loss": float(expected_loss(loss, sum(depths) / 2, depths, shares)),
        "surface_loss": float(expected_loss(loss, depths[0], depths, shares)),
        "least_at_m": float(estimates[np.isclose(expected, expected.min(), atol=1e-9)][0]),
    }


def _filter_step(recipe: Recipe, context: Context) -> dict[str, float]:
    """Fig. 3.3: a pixel without a sample between a near and a far surface, filled by the filter (1/4, 1/2, 1/4)."""
    from completion.depth_coefficients import Bins, decode, encode

    near, far = float(recipe.settings["near"]), float(recipe.settings["far"])
    bins = Bins(10, 1.0)
    depth = np.array([near, near, 0.0, far, far])
    weights = np.array([0.25, 0.5, 0.25])
    if recipe.settings["on"] == "depth":
        window, known = depth[1:4], depth[1:4] > 0
        estimate = float((weights * window)[known].sum() / weights[known].sum())
        return {"estimate_m": estimate, "mass_between": float(near + 1 < estimate < far - 1)}
    coefficients = np.tensordot(weights, encode(depth[1:4], bins), axes=1)
    share = coefficients / coefficients.sum()
    centres = np.arange(bins.channels) * bins.size
    between = (centres > near + 1) & (centres < far - 1)
    return {
        "estimate_m": float(decode(share, bins, "peak")),
        "mass_between": float(share[between].sum()),
    }


ANALYSES: dict[str, Callable[[Recipe, Context], dict[str, float]]] = {
    "expected_loss": _expected_loss,
    "filter_step": _filter_step,
}
