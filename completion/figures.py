"""The thesis' explaining figures, drawn from the same functions that train and score."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from completion.analysis import expected_loss

# Okabe and Ito's blue and orange.
LOSS, EXPECTED = "#0072B2", "#E69F00"


def loss_curves(gamma: float) -> dict[str, Callable[[Any], Any]]:
    """Loss curves of Fig. 2.5 and 4.3 on NumPy errors in metres."""
    return {
        "MSE": np.square,
        "MAE": np.abs,
        "tRMSE^2": lambda e: np.minimum(e**2, 1.0),
        "tMAE": lambda e: np.minimum(np.abs(e), 1.0),
        "ALE": lambda e: np.maximum(-e / gamma, gamma * e),
        "RALE": lambda e: np.maximum(e / gamma, -gamma * e),
    }


def plot_expected_losses(
    path: Path, depths: tuple[float, float] = (10.0, 13.0), probability: float = 0.5, gamma: float = 2.0
) -> Path:
    """Fig. 2.5 and 4.3: each loss above its expectation at a pixel with two possible depths; minima are black."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    error = np.linspace(-3, 3, 601)
    estimate = np.linspace(depths[0] - 2, depths[1] + 2, 1401)
    figure = Figure(figsize=(7.2, 8.6), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    axes = figure.subplots(4, 3)
    for number, (name, loss) in enumerate(loss_curves(gamma).items()):
        row, column = 2 * (number // 3), number % 3
        curve, expectation = axes[row, column], axes[row + 1, column]
        curve.plot(error, loss(error), color=LOSS)
        curve.set(title=name.replace("^2", "²"), xlabel="estimate - truth [m]", ylabel="loss" if column == 0 else "")
        expected = expected_loss(loss, estimate, depths, (probability, 1 - probability))
        least = estimate[np.isclose(expected, expected.min(), atol=1e-9)]
        expectation.plot(estimate, expected, color=EXPECTED)
        expectation.plot(least, np.full_like(least, expected.min()), ".", color="black")
        expectation.set(xlabel="estimate [m]", ylabel="expected loss" if column == 0 else "")
        for depth in depths:
            expectation.axvline(depth, color="grey", linewidth=0.8, linestyle=":")
    figure.savefig(path)
    return path
