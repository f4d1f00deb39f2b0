"""One figure per table: ours beside the thesis', in colours that colour-blind readers tell apart."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline.experiments import chapter_5_drawings
from pipeline.experiments.intervals import Estimate, estimate
from pipeline.experiments.plan import TableResult
from pipeline.experiments.tables import Column, Row

# Okabe and Ito's palette: blue ours, orange the thesis'. Their numbers are set darker, to be read on white.
OURS, THEIRS, THIRD = "#0072B2", "#E69F00", "#009E73"
THEIR_NUMBERS = "#8A5F00"
MARKERS = "osD^vPX"


def new_figure(width: float, height: float) -> Any:
    """A figure that needs no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _ours(result: TableResult, row: Row, column: Column) -> Estimate | None:
    return estimate(result.outcomes.get(row.label, []), row, column)


def draw_dots(result: TableResult, figure: Any) -> None:
    """Rows down, a panel per column: our mean with interval (dot), the thesis' value (diamond), each on its axis."""
    table = result.table
    axes = figure.subplots(1, len(table.columns), sharey=True, squeeze=False)[0]
    for index, (axis, column) in enumerate(zip(axes, table.columns)):
        printed = any(row.printed and row.printed[index] is not None for row in table.rows)
        other = axis.twiny() if printed else None
        for position, row in enumerate(table.rows):
            found = _ours(result, row, column)
            if found is not None:
                axis.plot(found.mean, position - 0.12, "o", color=OURS)
                axis.plot([found.low, found.high], [position - 0.12] * 2, color=OURS, linewidth=2)
            if other is not None and row.printed and row.printed[index] is not None:
                other.plot(row.printed[index], position + 0.12, "D", color=THEIRS, markersize=5)
        axis.set_xlabel(column.heading, color=OURS, fontsize=8)
        axis.tick_params(axis="x", labelcolor=OURS, labelsize=7)
        axis.grid(axis="y", alpha=0.3)
        if other is not None:
            other.tick_params(axis="x", labelcolor=THEIR_NUMBERS, labelsize=7)
    axes[0].set_yticks(range(len(table.rows)), [row.label for row in table.rows], fontsize=8)
    axes[0].set_ylim(len(table.rows) - 0.5, -0.5)


def _series(result: TableResult) -> dict[str, list[tuple[str, Row]]]:
    """Rows "64R TWISE" or "gamma 2" as (tick, row) by series; labels differ in one number."""
    series: dict[str, list[tuple[str, Row]]] = {}
    for row in result.table.rows:
        first, _, rest = row.label.partition(" ")
        name, tick = (rest, first) if first[:1].isdigit() else (first, rest)
        series.setdefault(name, []).append((tick, row))
    return series


def draw_curve(result: TableResult, figure: Any) -> None:
    """A panel per column: value against gamma or LiDAR rows; ours solid with intervals, the thesis' dashed."""
    table, series = result.table, _series(result)
    axes = figure.subplots(1, len(table.columns), squeeze=False)[0]
    colours = dict(zip(series, (OURS, THEIRS, THIRD, "#CC79A7", "#56B4E9")))
    # Intervals of several series stand side by side.
    aside = {name: 0.12 * (number - (len(series) - 1) / 2) for number, name in enumerate(series)}
    for index, (axis, column) in enumerate(zip(axes, table.columns)):
        printed_axis = (
            axis.twinx() if any(row.printed and row.printed[index] is not None for row in table.rows) else None
        )
        for marker, (name, rows) in zip(MARKERS, series.items()):
            found = [(position + aside[name], _ours(result, row, column)) for position, (_, row) in enumerate(rows)]
            done = [(position, one) for position, one in found if one is not None]
            axis.plot(
                [p for p, _ in done], [one.mean for _, one in done], f"{marker}-", ms=5, color=colours[name], label=name
            )
            for position, one in done:
                axis.plot([position] * 2, [one.low, one.high], color=colours[name], linewidth=1.5)
            theirs = [(p + aside[name], row.printed[index]) for p, (_, row) in enumerate(rows) if row.printed]
            theirs = [(p, value) for p, value in theirs if value is not None]
            if printed_axis is not None:
                printed_axis.plot(*zip(*theirs), f"{marker}--", color=colours[name], alpha=0.5, markersize=4)
        ticks = [tick for tick, _ in next(iter(series.values()))]
        axis.set_xticks(range(len(ticks)), ticks, fontsize=8)
        axis.set_title(textwrap.fill(column.heading, 20), fontsize=9)
        axis.tick_params(axis="y", labelsize=7)
        if printed_axis is not None:
            printed_axis.tick_params(axis="y", labelsize=7, colors="dimgrey")
        if len(series) == 1:
            axis.set_xlabel(next(iter(series)), fontsize=8)
    if len(series) > 1:
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(series), fontsize=8)


def draw_scatter(result: TableResult, figure: Any) -> None:
    """Fig. 4.11 (b, c): semi-dense against clean for MAE and RMSE; networks of one backbone are joined."""
    axes = figure.subplots(1, 2)
    for axis, key in zip(axes, ("mae_mm", "rmse_mm")):
        column = result.table.column(key)
        points: dict[str, list[tuple[float, float, str]]] = {}
        for row in result.table.rows:
            name, _, kind = row.label.partition(", ")
            if kind != "clean":
                continue
            clean, noisy = (_ours(result, result.table.row(f"{name}, {gt}"), column) for gt in ("clean", "semi-dense"))
            if clean is not None and noisy is not None:
                backbone, _, loss = name.partition(" ")
                points.setdefault(backbone, []).append((clean.mean, noisy.mean, loss))
        for colour, marker, (backbone, found) in zip((OURS, THEIRS), MARKERS, sorted(points.items())):
            found.sort()
            axis.plot([p[0] for p in found], [p[1] for p in found], f"{marker}-", color=colour, label=backbone)
            for x, y, loss in found:
                axis.annotate(loss, (x, y), textcoords="offset points", xytext=(4, 4), fontsize=7)
        axis.set(xlabel=f"{column.heading}, clean", ylabel=f"{column.heading}, semi-dense")
        axis.grid(alpha=0.3)
        axis.margins(0.12)
        if points:
            axis.legend(fontsize=8)


def draw_expected_loss(result: TableResult, figure: Any) -> None:
    """Fig. 2.5 and 4.3: each loss above, its expectation at a pixel of two possible depths below."""
    import numpy as np

    from completion.analysis import expected_loss
    from completion.figures import loss_curves

    rows = [row for row in result.table.rows if row.recipe is not None]
    axes = figure.subplots(2, len(rows), squeeze=False)
    for column, row in enumerate(rows):
        assert row.recipe is not None
        settings = row.recipe.settings
        loss = loss_curves(float(settings["gamma"]))[row.label]
        near, far = settings["depths"]
        error, depth = np.linspace(-3, 3, 601), np.linspace(near - 2, far + 2, 1401)
        shares = (settings["probability"], 1 - settings["probability"])
        axes[0, column].plot(error, loss(error), color=OURS)
        axes[0, column].set(title=row.label.replace("^2", "²"), xlabel="estimate - truth [m]")
        axes[1, column].plot(depth, expected_loss(loss, depth, (near, far), shares), color=THEIRS)
        axes[1, column].set(xlabel="estimate [m]", ylabel="expected loss" if column == 0 else "")
        for x in (near, far):
            axes[1, column].axvline(x, color="grey", linewidth=0.8, linestyle=":")


def draw_relative_errors(result: TableResult, figure: Any) -> None:
    """Fig. 4.7 and 4.8: where TWISE is better (positive) in one test frame, and histograms over several."""
    import numpy as np

    from completion.analysis import relative_error_histograms

    folder = result.folders[next(iter(result.outcomes))][0]
    with np.load(folder / "maps.npz") as maps:
        both = {"absolute error [m]": maps["absolute"], "squared error [m²]": maps["squared"]}
    axes = figure.subplots(2, 2)
    for column, ((title, stack), limit) in enumerate(zip(both.items(), (2.0, 10.0))):
        shown = axes[0, column].imshow(stack[0], cmap="PuOr_r", vmin=-limit, vmax=limit)
        axes[0, column].set_title(f"difference of {title}: orange, TWISE better", fontsize=8)
        axes[0, column].set_axis_off()
        figure.colorbar(shown, ax=axes[0, column], shrink=0.8)
        edges, better, worse = relative_error_histograms(list(stack))
        axes[1, column].stairs(better, edges, color=THEIRS, label="TWISE better")
        axes[1, column].stairs(worse, edges, color=OURS, label="TWISE worse")
        axes[1, column].set(xscale="log", yscale="symlog", xlabel=f"|difference of {title}|", ylabel="pixels")
        axes[1, column].legend(fontsize=7)


def draw_error_maps(result: TableResult, figure: Any) -> None:
    """Fig. 4.9: image above, absolute error from 0 to 5 m below, a line per network."""
    import matplotlib
    import numpy as np

    files = {label: result.folders[label][0] / "examples.npz" for label in result.outcomes}
    with np.load(next(iter(files.values()))) as examples:
        frames = sum(name.startswith("image_") for name in examples.files)  # one where only one was tested
    colours = matplotlib.colormaps["magma"].with_extremes(bad="#9AA0A6")
    figure.set_size_inches(11, 0.9 + (1.75 if frames > 1 else 3) * (1 + len(files)))
    axes = figure.subplots(1 + len(files), frames, squeeze=False)
    for line, (label, path) in enumerate(files.items(), start=1):
        with np.load(path) as examples:
            for column in range(frames):
                target = examples[f"clean_{column}"].astype(np.float32)
                error = np.abs(examples[f"depth_{column}"].astype(np.float32) - target)
                axes[0, column].imshow(examples[f"image_{column}"])
                shown = axes[line, column].imshow(np.where(target > 0, error, np.nan), cmap=colours, vmin=0, vmax=5)
                axes[line, column].set_title(label, fontsize=8)
    for axis in axes.ravel():
        axis.set_axis_off()
    figure.colorbar(shown, ax=axes, label="error [m]; grey: no true depth", shrink=0.7)


DRAWINGS: dict[str, Callable[[TableResult, Any], None]] = {
    **chapter_5_drawings.DRAWINGS,
    "dots": draw_dots,
    "curve": draw_curve,
    "scatter": draw_scatter,
    "expected_loss": draw_expected_loss,
    "relative_errors": draw_relative_errors,
    "error_maps": draw_error_maps,
}
LEGENDS = {
    "dots": "blue dots: ours with 95 % interval; orange diamonds: thesis (upper axis)",
    "curve": "solid: ours with 95 % interval; dashed: thesis (right axis)",
    "scatter": "means over seeds",
}
# Where the thesis prints no number.
OURS_ALONE = {"dots": "dots: ours with 95 % interval", "curve": "ours with 95 % interval"}


def draw(result: TableResult, path: Path) -> Path | None:
    """Draws the figure of a table with any result; None when there is nothing to draw."""
    table = result.table
    if not result.outcomes:
        return None
    kind = table.drawing if table.drawing in DRAWINGS else "dots"
    size = (3 + 1.9 * len(table.columns), 1.8 + 0.28 * len(table.rows)) if kind == "dots" else (11.0, 4.6)
    figure = new_figure(*chapter_5_drawings.SIZES.get(kind, size))
    DRAWINGS[kind](result, figure)
    printed = any(value is not None for row in table.rows for value in row.printed or ())
    legend = LEGENDS.get(kind, "") if printed or kind == "scatter" else OURS_ALONE.get(kind, "")
    figure.suptitle(f"{table.heading}: {table.title}" + (f"\n{legend}" if legend else ""), fontsize=9)
    temporary = path.with_name(f".writing-{path.name}")
    figure.savefig(temporary, dpi=90, format="png", metadata={"Software": None})
    temporary.replace(path)
    return path
