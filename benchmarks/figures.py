"""The picture beside the tables: how many times faster than each peer, and how costs grow."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.record import Curve, Measure


def draw(measures: Sequence[Measure], curves: Sequence[Curve], path: Path) -> Path:
    """Bars of ratios to the best peer (log scale, 1 is a tie) and costs over sizes (both axes log) in one PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    compared = [item for item in measures if item.peers]
    height = max(4.0, 0.24 * len(compared) + 1.2)
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(14, height), width_ratios=(1, 1.1))
    _bars(left, compared)
    _growth(right, curves)
    figure.tight_layout()
    figure.savefig(path, dpi=90, bbox_inches="tight")
    pyplot.close(figure)
    return path


def _bars(axes, compared: Sequence[Measure]) -> None:  # type: ignore[no-untyped-def]
    labels = [f"{item.case}  /  {item.best_peer}" for item in compared]
    values = [item.ratio(str(item.best_peer)) for item in compared]
    places = np.arange(len(values))[::-1]
    colours = ["#0072b2" if value >= 1 else "#d55e00" for value in values]
    axes.barh(places, np.log10(values) if values else [], color=colours, height=0.7)
    for place, value in zip(places, values):
        axes.text(max(0.0, float(np.log10(value))) + 0.02, place, f"{value:.2g}", va="center", fontsize=7)
    axes.set_yticks(places, labels, fontsize=6.5)
    ticks = [1, 2, 5, 10, 20, 50]
    axes.set_xticks(np.log10(ticks), [str(tick) for tick in ticks])
    axes.set_ylim(-0.8, len(values) - 0.2)
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_xlabel("times better than the best peer, same run")


def _growth(axes, curves: Sequence[Curve]) -> None:  # type: ignore[no-untyped-def]
    colours = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
    for number, curve in enumerate(curves):
        relative = np.array(curve.sizes) / curve.sizes[0]
        label = f"{curve.name}: {curve.sizes[0]:g} to {curve.sizes[-1]:g}, slope {curve.slope:.2f}"
        colour, marker = colours[number % len(colours)], "osv^D"[number // len(colours) % 5]
        axes.plot(relative, 1e3 * np.array(curve.seconds), marker=marker, markersize=4, color=colour, label=label)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("size, times the smallest")
    axes.set_ylabel("milliseconds")
    axes.grid(True, which="both", linewidth=0.3)
    if curves:
        axes.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=2)
