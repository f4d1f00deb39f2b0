"""Result rows as Markdown and LaTeX tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from detection.evaluation.bootstrap import Difference, Interval
from detection.evaluation.difficulty import LEVELS
from detection.evaluation.kitti_ap import ApRow, Report
from detection.evaluation.protocol import EVERYWHERE, Range

METRIC_NAMES = {"2d": "2D", "aos": "AOS", "bev": "BEV", "3d": "3D"}


def range_text(bounds: Sequence[float | None] | Range) -> str:
    """ "all" or "0-30 m"."""
    lo, hi = bounds
    if (lo, hi) == EVERYWHERE:
        return "all"
    return f"{lo:g}-{'inf' if hi is None else f'{hi:g}'} m"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def markdown_table(report: Report) -> str:
    """One Markdown row per result in percent: AP at the three levels, then all three of exact AP and of recall.

    Exact AP is the area under the whole curve; recall is the share of objects found when every score is admitted.
    """
    lines = [
        "| class | metric | IoU | range | easy | moderate | hard | exact AP | recall | objects |",
        "|---|---|---:|---|---:|---:|---:|---|---|---|",
    ]
    exact, recall = _triples(report["exact"]), _triples(report["recall"])
    for row in report["results"]:
        key = (row["class"], row["metric"], row["iou"], *row["range"])
        cells = [row["class"], f"{METRIC_NAMES[row['metric']]} R{row['recall_points']}", f"{row['iou']:g}"]
        cells += [range_text(row["range"]), _number(row["easy"]), _number(row["moderate"]), _number(row["hard"])]
        cells += [exact.get(key, "-"), recall.get(key, "-"), " / ".join(map(str, row["n_gt"]))]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _triples(rows: Sequence[dict[str, Any]]) -> dict[tuple[Any, ...], str]:
    """Row key -> "easy / moderate / hard" with one decimal."""
    texts = {}
    for row in rows:
        values = ["-" if row[level] is None else f"{row[level]:.1f}" for level in LEVELS]
        texts[(row["class"], row["metric"], row["iou"], *row["range"])] = " / ".join(values)
    return texts


def latex_table(rows: Sequence[ApRow]) -> str:
    """A LaTeX tabular (booktabs), a rule between classes."""
    lines = [
        r"\begin{tabular}{llrlrrr}",
        r"\toprule",
        r"Class & Metric & IoU & Range & Easy & Moderate & Hard \\",
        r"\midrule",
    ]
    previous = rows[0]["class"] if rows else ""
    for row in rows:
        if row["class"] != previous:
            lines.append(r"\midrule")
            previous = row["class"]
        name = row["class"].replace("_", r"\_")
        metric = rf"{METRIC_NAMES[row['metric']]} $R_{{{row['recall_points']}}}$"
        cells = [name, metric, f"{row['iou']:g}", range_text(row["range"]).replace("-", "--")]
        cells += [_number(row["easy"]), _number(row["moderate"]), _number(row["hard"])]
        lines.append(" & ".join(cells) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def interval_table(intervals: Sequence[Interval], confidence: float) -> str:
    """AP with percentile intervals as Markdown, three levels per row."""
    lines = [
        f"AP with {100 * confidence:g} % bootstrap intervals over frames",
        "",
        "| class | metric | IoU | range | easy | moderate | hard |",
        "|---|---|---:|---|---|---|---|",
    ]
    for start in range(0, len(intervals), len(LEVELS)):
        group = intervals[start : start + len(LEVELS)]
        target = group[0].target
        cells = [
            "-" if item.ap is None else f"{item.ap:.2f} [{_number(item.low)}, {_number(item.high)}]" for item in group
        ]
        metric = METRIC_NAMES[target.metric]
        lines.append(f"| {target.cls} | {metric} | {target.iou:g} | {range_text(target.range)} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def difference_table(differences: Sequence[Difference], confidence: float) -> str:
    """Paired differences as Markdown; a star marks intervals without 0."""
    lines = [
        f"Difference to the baseline with {100 * confidence:g} % paired bootstrap intervals over frames; * = without 0",
        "",
        "| class | metric | IoU | range | level | result | AP | difference | interval | better in |",
        "|---|---|---:|---|---|---|---:|---:|---|---:|",
    ]
    for item in differences:
        target = item.target
        star = " *" if item.low > 0 or item.high < 0 else ""
        head = f"| {target.cls} | {METRIC_NAMES[target.metric]} | {target.iou:g} | {range_text(target.range)} "
        lines.append(
            f"{head}| {item.level} | {item.name} - {item.baseline} | {item.ap:.2f} | {item.difference:+.2f} "
            f"| [{item.low:+.2f}, {item.high:+.2f}]{star} | {100 * item.share_above:.0f} % |"
        )
    return "\n".join(lines) + "\n"
