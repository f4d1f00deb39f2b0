"""metrics.json as tables: Markdown for tables.md, rows for the console and the report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

# Depth measures in words; the keys are those of metrics.json (`completion.metrics.depth_metrics`).
DEPTH_NAMES = {
    "mae_mm": "mean error (MAE), mm",
    "rmse_mm": "RMSE, mm",
    "tmae_mm": "thresholded MAE, mm",
    "trmse_mm": "thresholded RMSE, mm",
    "imae_per_km": "inverse MAE, 1/km",
    "irmse_per_km": "inverse RMSE, 1/km",
    "rel": "relative error",
    "squared_rel": "squared relative error",
    "lg10": "log₁₀ error",
    "silog": "scale-invariant log error",
    "valid_pixels": "pixels compared",
    "floored_pixels": "pixels raised to 0.1 m",
    "delta_1.02": "ratio below 1.02, %",
    "delta_1.05": "ratio below 1.05, %",
    "delta_1.10": "ratio below 1.10, %",
    "delta_1.25": "ratio below 1.25, %",
    "delta_1.25^2": "ratio below 1.25², %",
    "delta_1.25^3": "ratio below 1.25³, %",
}
METRIC_NAMES = {"2d": "2D box", "aos": "orientation", "bev": "bird's eye", "3d": "3D box"}


def ap_rows(metrics: dict[str, Any]) -> list[list[str]]:
    """Class, metric, IoU, easy, moderate, hard, valid objects: text cells, "-" where nothing was detected."""
    return [
        [
            row["class"] + _range_text(row["range"]),
            METRIC_NAMES.get(row["metric"], row["metric"]),
            f"{row['iou']:g}",
            *("-" if row[level] is None else f"{row[level]:.2f}" for level in ("easy", "moderate", "hard")),
            " / ".join(str(count) for count in row["n_gt"]),
        ]
        for row in metrics.get("results", [])
        if any(row["n_gt"])
    ]


def ap_header(metrics: dict[str, Any]) -> list[str]:
    """Column names of `ap_rows`."""
    points = {row["recall_points"] for row in metrics.get("results", [])}
    kind = f"AP R{points.pop()}" if len(points) == 1 else "AP"
    return ["class", kind, "IoU", "easy", "moderate", "hard", "objects e / m / h"]


def _range_text(bounds: Sequence[float | None]) -> str:
    low, high = bounds
    if not low and high is None:
        return ""
    return f" {low:g}-{'∞' if high is None else f'{high:g}'} m"


def depth_rows(metrics: dict[str, Any]) -> list[list[str]]:
    """Depth measure and its mean over the frames with ground truth."""
    return [[name, number(value)] for name, value in metrics.get("depth", {}).get("mean", {}).items()]


def number(value: float) -> str:
    """Four significant digits without an exponent: 0.1428, 305.4, 15,940."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def step_rows(metrics: dict[str, Any]) -> list[list[str]]:
    """Augmentation step with mean points in and out."""
    return [
        [step["step"].replace("_", " "), f"{step['in']:,}", f"{step['out']:,}"]
        for step in metrics.get("augmentation", [])
    ]


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, first column to the left, others to the right."""
    lines = [
        "| " + " | ".join(header) + " |",
        "|" + "|".join("---" if column == 0 else "---:" for column in range(len(header))) + "|",
    ]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def markdown_tables(metrics: dict[str, Any]) -> str:
    """The text of tables.md."""
    parts = ["# Results\n"]
    rows = ap_rows(metrics)
    if rows:
        parts.append("## Average precision (percent)\n\n" + markdown_table(ap_header(metrics), rows))
    if metrics.get("warnings"):
        parts.append("".join(f"- {warning}\n" for warning in metrics["warnings"]))
    without = metrics.get("frames", {}).get("without_label", [])
    if without:
        parts.append(f"Frames without a label, not scored: {', '.join(without)}\n")
    if depth_rows(metrics):
        title = f"## Completed depth against ground truth (mean over {metrics['depth']['frames']} frames)\n\n"
        parts.append(title + markdown_table(["measure", "value"], depth_rows(metrics)))
    if step_rows(metrics):
        title = "## Points per augmentation step (mean over frames)\n\n"
        parts.append(title + markdown_table(["step", "points in", "points out"], step_rows(metrics)))
    return "\n".join(parts)
