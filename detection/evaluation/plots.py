"""Precision-recall curves and score histograms, as CSV and as pictures (matplotlib is imported when one is drawn)."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

from detection.evaluation.curves import SAMPLES
from detection.evaluation.difficulty import LEVELS
from detection.evaluation.explain import FALSE_POSITIVE, MATCHED, explain
from detection.evaluation.kitti_ap import Evaluation
from detection.evaluation.matcher import Matcher
from detection.evaluation.objects import Array
from detection.evaluation.protocol import Target
from detection.evaluation.tables import METRIC_NAMES, range_text

CURVE_COLUMNS = (
    "class",
    "metric",
    "iou",
    "range",
    "level",
    "sample",
    "sample_recall",
    "score_threshold",
    "tp",
    "fp",
    "recall",
    "precision",
    "interpolated",
)


def write_curves(evaluation: Evaluation, folder: Path, *, pictures: bool = True) -> list[Path]:
    """curves.csv, scores.csv and one picture of each per class and range in `folder`; returns what was written.

    pictures  False: the tables alone, without matplotlib
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = [folder / "curves.csv", folder / "scores.csv"]
    _write_csv(
        written[0], CURVE_COLUMNS, [row for target in evaluation.targets for row in curve_rows(evaluation, target)]
    )
    strictest: dict[tuple[str, Any, str], Target] = {}
    for target in evaluation.targets:
        key = (target.cls, target.range, target.metric)
        if key not in strictest or target.iou > strictest[key].iou:
            strictest[key] = target
    histogram_rows: list[tuple[Any, ...]] = []
    for cls, bounds in dict.fromkeys((target.cls, target.range) for target in evaluation.targets):
        chosen = [target for (name, where, _), target in strictest.items() if (name, where) == (cls, bounds)]
        suffix = "" if range_text(bounds) == "all" else f"_{range_text(bounds).replace(' ', '')}"
        edges, groups = score_histogram(evaluation.matcher, chosen[-1], level=1)
        if pictures:
            drawn = [folder / f"{what}_{cls}{suffix}.png" for what in ("curves", "scores")]
            _draw_curves(evaluation, chosen, drawn[0])
            _draw_histogram(edges, groups, f"{_title(chosen[-1])}, moderate", drawn[1])
            written += drawn
        for name, counts in groups.items():
            histogram_rows += [
                (cls, chosen[-1].metric, range_text(bounds), name, f"{low:.6g}", f"{high:.6g}", int(count))
                for low, high, count in zip(edges, edges[1:], counts)
            ]
    _write_csv(written[1], ("class", "metric", "range", "outcome", "from", "to", "count"), histogram_rows)
    return written


def curve_rows(evaluation: Evaluation, target: Target) -> list[tuple[Any, ...]]:
    """The samples of the three curves of a target, in the columns CURVE_COLUMNS."""
    rows = []
    for level, curve in zip(LEVELS, evaluation.curves(target)):
        interpolated = curve.orientation() if target.metric == "aos" else curve.precision()
        raw = curve.similarity / np.maximum(curve.tp + curve.fp, 1) if target.metric == "aos" else curve.raw_precision
        head = (target.cls, target.metric, target.iou, range_text(target.range), level)
        for k in range(SAMPLES):
            used = k < len(curve.thresholds)
            counts = (curve.thresholds[k], int(curve.tp[k]), int(curve.fp[k])) if used else ("", "", "")
            values = (f"{curve.recall[k]:.6f}", f"{raw[k]:.6f}") if used else ("", "")
            rows.append((*head, k, k / 40, *counts, *values, f"{interpolated[k]:.6f}"))
    return rows


def score_histogram(matcher: Matcher, target: Target, level: int, bins: int = 20) -> tuple[Array, dict[str, Array]]:
    """Bin edges (bins + 1,) and counts (bins,) of scores per outcome: true positive, false positive, ignored."""
    outcome = [item.status for item in explain(matcher, target, level) if item.side == "detection"]
    status = np.array(outcome, dtype=object)
    of_class = matcher.pair.detections.is_type(target.cls)
    scores = matcher.pair.detections.score
    edges = np.histogram_bin_edges(scores[of_class], bins=bins) if of_class.any() else np.linspace(0, 1, bins + 1)
    right, wrong = of_class & (status == MATCHED), of_class & (status == FALSE_POSITIVE)
    groups = {"true positive": right, "false positive": wrong, "ignored": of_class & ~right & ~wrong}
    return edges, {name: np.histogram(scores[mask], edges)[0] for name, mask in groups.items()}


def _write_csv(path: Path, columns: tuple[str, ...], rows: list[tuple[Any, ...]]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


def _title(target: Target) -> str:
    where = range_text(target.range)
    return f"{target.cls} {METRIC_NAMES[target.metric]}, IoU {target.iou:g}" + ("" if where == "all" else f", {where}")


def _draw_curves(evaluation: Evaluation, targets: list[Target], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.4 * len(targets), 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"AP with {evaluation.recall_points} recall points", fontsize=10)
    recall = np.arange(SAMPLES) / 40
    for place, target in enumerate(targets, start=1):
        axes = figure.add_subplot(1, len(targets), place)
        for level, curve, ap in zip(LEVELS, evaluation.curves(target), evaluation.average_precision(target)):
            values = curve.orientation() if target.metric == "aos" else curve.precision()
            axes.plot(recall, values, drawstyle="steps-pre", label=f"{level} {'-' if ap is None else f'{ap:.1f}'}")
        axes.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="recall", title=_title(target))
        axes.set_ylabel("similarity" if target.metric == "aos" else "precision")
        axes.grid(alpha=0.3)
        axes.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.17),
            ncols=3,
            frameon=False,
            fontsize=8,
            columnspacing=1.0,
            handlelength=1.2,
        )
    figure.savefig(path, dpi=110)


def _draw_histogram(edges: Array, groups: dict[str, Array], title: str, path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    floor = np.zeros(len(edges) - 1)
    for (name, counts), colour in zip(groups.items(), ("tab:green", "tab:red", "lightgrey")):
        label = f"{name} ({int(counts.sum())})"
        axes.bar(edges[:-1], counts, np.diff(edges), floor, align="edge", color=colour, label=label)
        floor = floor + counts
    axes.set(xlabel="score", ylabel="detections", title=title)
    axes.legend()
    figure.savefig(path, dpi=110)
