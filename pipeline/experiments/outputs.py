"""A table beside the thesis' numbers as Markdown, LaTeX and CSV. No times in them: equal runs give equal files."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

from auglidar_base.atomic import write_text
from pipeline.experiments.intervals import Estimate, estimate
from pipeline.experiments.plan import Order, TableResult
from pipeline.experiments.runs import available
from pipeline.experiments.tables import Column, Row

WARNING = (
    "Ours are small networks, trained briefly on other data: the absolute values cannot be compared with the thesis', "
    "only the order of the rows."
)
SYNTHETIC = "the synthetic world"


def describe(order: Order, result: TableResult) -> list[str]:
    """What the numbers were made from, line by line."""
    data = SYNTHETIC if order.data is None else order.data.name
    changed = {kind: dict(changes) for kind, changes in (order.changes or {}).items() if changes}
    lines = [f"Data: {data}. Budget: {order.budget}{f' with {changed}' if changed else ''}. Seeds: {order.seeds}."]
    if result.table.needs == "nothing":
        lines = ["An exact computation: no data, no training, the same for every budget and seed."]
    lines.append(f"Command: {command(order, result)}")
    return lines


def command(order: Order, result: TableResult) -> str:
    """The command that makes the table."""
    data = "" if order.data is None else f" --data {order.data.name}"
    rows = f" --rows {result.table.lidar_rows}" if result.table.lidar_rows else ""
    return (
        f"run_pipeline --stage experiment --{result.table.kind} {result.table.number} --budget {order.budget} "
        f"--seeds {order.seeds}{rows}{data}"
    )


def cell(found: Estimate | None, column: Column) -> str:
    """ "201.3 ± 4.0 [195.1, 207.5]": mean, deviation over seeds, 95 % interval."""
    if found is None:
        return ""
    digits = column.digits
    text = f"{found.mean:.{digits}f}"
    if not math.isnan(found.deviation):
        text += f" ± {found.deviation:.{digits}f}"
    if not math.isnan(found.low):
        text += f" [{found.low:.{digits}f}, {found.high:.{digits}f}]"
    return text


def _printed(row: Row, index: int, column: Column) -> str:
    value = row.printed[index] if row.printed else None
    return "" if value is None else f"{value:.{column.digits}f}"


def status(row: Row, result: TableResult) -> str:
    """Why a row has no numbers of ours, or of fewer seeds than asked for; "" when it has all."""
    if row.recipe is None:
        return row.reason
    if not available(row.recipe.kind):
        return "cannot be computed by this installation"
    done, asked = len(result.outcomes.get(row.label, [])), len(result.folders.get(row.label, []))
    if not done:
        return "not run yet"
    return f"{done} of {asked} seeds" if done < asked else ""


def markdown(order: Order, result: TableResult) -> str:
    """The table with both numbers, the claims, the misprints."""
    table = result.table
    purpose = table.purpose if table.purpose.endswith("?") else f"{table.purpose}."
    *made_from, command_line = describe(order, result)
    lines = [f"# {table.heading}: {table.title}", "", f"Purpose: {purpose}", "", *(f"- {line}" for line in made_from)]
    lines.append("- {} `{}`".format(*command_line.split(" ", 1)))
    if any(row.printed for row in table.rows):
        lines.append(f"- {WARNING}")
    lines += [f"- {note[0].upper()}{note[1:]}." for note in table.notes]
    shown = "Ours: mean ± deviation over seeds [95 % interval]; below it, in brackets, the thesis' value."
    lines += ["", shown if table.of_thesis else "Mean ± deviation over seeds [95 % interval].", ""]
    lines += [
        "| | " + " | ".join(column.heading for column in table.columns) + " |",
        "|---|" + "---|" * len(table.columns),
    ]
    for row in table.rows:
        cells = []
        for index, column in enumerate(table.columns):
            ours, theirs = (
                cell(estimate(result.outcomes.get(row.label, []), row, column), column),
                _printed(row, index, column),
            )
            cells.append(" ".join(part for part in (ours, f"({theirs})" if theirs else "") if part))
        why = status(row, result)
        lines.append(f"| {row.label}{f' *({why})*' if why else ''} | " + " | ".join(cells) + " |")
    lines += _claims(result)
    if table.misprints:
        lines += ["", "## Misprints of the thesis", "", *(f"- {text}" for text in table.misprints)]
    return "\n".join(lines) + "\n"


def _claims(result: TableResult) -> list[str]:
    if not result.verdicts:
        return []
    whose = "Orderings that the thesis claims" if result.table.of_thesis else "Orderings"
    lines = ["", f"## {whose}", "", "| claim | in our runs | margin, paired |", "|---|---|---|"]
    return lines + [f"| {v.text} | **{v.verdict}** | {v.evidence} |" for v in result.verdicts]


_SPECIAL = str.maketrans({
    "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}", "\\": r"\textbackslash{}", "±": r"$\pm$", "<": r"$<$", ">": r"$>$",
})  # fmt: skip


def latex_text(text: str) -> str:
    """Text with the characters escaped that LaTeX reads as commands."""
    return text.translate(_SPECIAL)


def latex(order: Order, result: TableResult) -> str:
    """A tabular with \\hline rules, no packages needed: per column ours and the thesis'."""
    table = result.table
    head = " & ".join(f"\\multicolumn{{2}}{{c}}{{{latex_text(column.heading)}}}" for column in table.columns)
    lines = [f"% {line}" for line in describe(order, result)]
    lines += [r"\begin{tabular}{l" + "rr" * len(table.columns) + "}", r"\hline", f" & {head} \\\\"]
    lines += [" & " + " & ".join(["ours & thesis"] * len(table.columns)) + r" \\", r"\hline"]
    for row in table.rows:
        cells = [latex_text(row.label)]
        for index, column in enumerate(table.columns):
            found = estimate(result.outcomes.get(row.label, []), row, column)
            spread = "" if found is None or math.isnan(found.deviation) else f" ± {found.deviation:.{column.digits}f}"
            ours = "--" if found is None else f"{found.mean:.{column.digits}f}{spread}"
            cells += [latex_text(ours) if found else ours, _printed(row, index, column) or "--"]
        lines.append(" & ".join(cells) + r" \\")
    return "\n".join([*lines, r"\hline", r"\end{tabular}"]) + "\n"


def csv_text(result: TableResult) -> str:
    """One line per row and column: ours, deviation, interval, how it was made, seeds, the thesis' value."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(
        ["row", "column", "unit", "ours", "deviation", "low", "high", "interval", "seeds", "thesis", "status"]
    )
    for row in result.table.rows:
        outcomes = result.outcomes.get(row.label, [])
        for index, column in enumerate(result.table.columns):
            found = estimate(outcomes, row, column)
            numbers = [] if found is None else [found.mean, found.deviation, found.low, found.high]
            ours = ["" if math.isnan(value) else f"{value:.6g}" for value in numbers] or [""] * 4
            how = "" if found is None else found.how
            writer.writerow(
                [
                    row.label,
                    column.title,
                    column.unit,
                    *ours,
                    how,
                    len(outcomes),
                    _printed(row, index, column),
                    status(row, result),
                ]
            )
    return out.getvalue()


def write_outputs(order: Order, result: TableResult, folder: Path) -> list[Path]:
    """Writes NAME.md, .tex, .csv and .png; returns them."""
    from pipeline.experiments.figures import draw

    stem = folder / result.table.name
    figure = draw(result, stem.with_name(stem.name + ".png"))
    shown = f"\n![{result.table.heading}: {result.table.title}]({stem.name}.png)\n" if figure else ""
    texts = {".md": markdown(order, result) + shown, ".tex": latex(order, result), ".csv": csv_text(result)}
    written = []
    for suffix, text in texts.items():
        path = stem.with_name(stem.name + suffix)
        write_text(path, text)
        written.append(path)
    return [*written, *([figure] if figure else [])]


def as_json(order: Order, result: TableResult) -> dict[str, object]:
    """The same as plain values."""
    rows = []
    for row in result.table.rows:
        outcomes = result.outcomes.get(row.label, [])
        ours = {}
        for column in result.table.columns:
            found = estimate(outcomes, row, column)
            if found is not None:
                values = (
                    ("mean", found.mean),
                    ("deviation", found.deviation),
                    ("low", found.low),
                    ("high", found.high),
                )
                ours[column.key] = {name: None if math.isnan(value) else value for name, value in values}
        printed = dict(zip((column.key for column in result.table.columns), row.printed))
        rows.append({"label": row.label, "ours": ours, "thesis": printed, "status": status(row, result)})
    return {
        "table": result.table.heading,
        "title": result.table.title,
        "command": command(order, result),
        "rows": rows,
        "claims": [{"text": v.text, "verdict": v.verdict, "evidence": v.evidence} for v in result.verdicts],
    }
