"""What a run prints at its end: the summary of the stages, the AP table, the estimate of a dry run."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from pipeline.base.paths import RunFolder
from pipeline.base.progress import duration
from pipeline.run_folder.config import Config
from pipeline.runner.batch import StageSummary
from pipeline.scoring.tables import ap_header, ap_rows, depth_rows

if TYPE_CHECKING:
    from pipeline.runner.estimate import StageEstimate

# Notes printed with the results; all of them stand in tables.md and in the report.
NOTES = 3


def print_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A table on standard output, first column to the left, numbers to the right; no wider than it must be."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", title_style="bold")
    for index, name in enumerate(header):
        table.add_column(name, justify="left" if index == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    # A log file has no width; a fixed one keeps tables whole.
    width = None if _is_terminal() else 120
    Console(width=width, highlight=False).print(table)


def _is_terminal() -> bool:
    import sys

    return sys.stdout.isatty()


def print_summary(summaries: Sequence[StageSummary]) -> None:
    """One line per stage: frames done now, up to date, failed, left out, seconds per frame."""
    rows = [
        [
            item.stage,
            *(str(n) if n else "-" for n in (item.done, item.up_to_date, item.failed, item.blocked, item.left)),
            f"{item.seconds / item.done:.2f} s" if item.done else "-",
            duration(item.seconds) if item.done else "-",
        ]
        for item in summaries
    ]
    if rows:
        header = ["stage", "done", "up to date", "failed", "left out", "not reached", "per frame", "work"]
        print_table("Frames", header, rows)


def run_record(
    run: RunFolder, stage: str, summaries: Sequence[StageSummary], failures: Sequence[Any], stopped: bool
) -> dict[str, Any]:
    """What `--json` says of a run: counts per stage, where the results lie, and the scores when they were made."""
    record: dict[str, Any] = {
        "stopped": stopped,
        "stages": [asdict(item) | {"left": item.left} for item in summaries],
        "failures": str(run.failures) if failures else None,
    }
    if stage in ("evaluate", "report") and not stopped:
        record["metrics"] = json.loads(run.metrics.read_text(encoding="utf-8"))
        record["report"] = str(run.report) if stage == "report" else None
    return record


def print_results(run: RunFolder) -> None:
    """The AP table and depth errors of metrics.json, with the warnings a reader must know."""
    metrics = json.loads(run.metrics.read_text(encoding="utf-8"))
    if ap_rows(metrics):
        print_table("Average precision (percent)", ap_header(metrics), ap_rows(metrics))
    if depth_rows(metrics):
        print_table("Completed depth", ["measure", "mean"], depth_rows(metrics))
    warnings = metrics.get("warnings", [])
    for warning in warnings[:NOTES]:
        print(f"note: {warning}")
    if len(warnings) > NOTES:
        print(f"note: {len(warnings) - NOTES} more in {run.tables}")


def print_dry_run(estimates: Sequence[StageEstimate], run: RunFolder, config: Config) -> None:
    """Frames, files, gigabytes and minutes per stage, and whether the disk has room."""
    rows = [
        [
            item.stage,
            str(item.frames),
            str(item.files),
            f"{item.gigabytes:.2f}",
            f"{item.minutes:.1f}",
            "measured" if item.measured else "default",
        ]
        for item in estimates
    ]
    files, gigabytes = sum(item.files for item in estimates), sum(item.gigabytes for item in estimates)
    rows.append(["total", "", str(files), f"{gigabytes:.2f}", f"{sum(item.minutes for item in estimates):.1f}", ""])
    print_table(f"Dry run: {run.root}", ["stage", "frames", "files", "GB", "minutes", "time per frame"], rows)
    folder = next(path for path in (run.root, *run.root.absolute().parents) if path.exists())
    free = shutil.disk_usage(folder).free / 1e9
    room = free - config.run.keep_free_gb - gigabytes
    print(f"{free:.1f} GB free at {folder}" + ("" if room > 0 else f": {-room:.1f} GB too little"))
