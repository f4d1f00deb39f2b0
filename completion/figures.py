"""The thesis' explaining figures, drawn from the same functions that train and score."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from completion.analysis import expected_loss, relative_error_histograms
from completion.types import FloatMap


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
    """Fig. 2.5 and 4.3: each loss, and its expectation at a pixel with two possible depths; minima are marked."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    error = np.linspace(-3, 3, 601)
    estimate = np.linspace(depths[0] - 2, depths[1] + 2, 1401)
    figure = Figure(figsize=(14, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 6)
    for column, (name, loss) in enumerate(loss_curves(gamma).items()):
        axes[0, column].plot(error, loss(error))
        axes[0, column].set(title=name, xlabel="estimate - truth [m]")
        expected = expected_loss(loss, estimate, depths, (probability, 1 - probability))
        least = estimate[np.isclose(expected, expected.min(), atol=1e-9)]
        axes[1, column].plot(estimate, expected)
        axes[1, column].plot(least, np.full_like(least, expected.min()), "r.", label="least")
        axes[1, column].set(xlabel="estimate [m]", ylabel="expected loss" if column == 0 else "")
    figure.savefig(path)
    return path


def plot_relative_errors(path: Path, maps: Sequence[FloatMap], unit: str = "m") -> Path:
    """Fig. 4.8: how many pixels improve and worsen, by how much, on logarithmic axes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    edges, improved, worsened = relative_error_histograms(maps)
    figure = Figure(figsize=(6, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.stairs(improved, edges, label="improved")
    axes.stairs(worsened, edges, label="worsened")
    axes.set(xscale="log", yscale="symlog", xlabel=f"difference of errors [{unit}]", ylabel="pixels")
    axes.legend()
    figure.savefig(path)
    return path
