"""`run_pipeline --stage experiment`: tables and figures of the thesis, run here beside what it printed."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.base.errors import UsageError

if TYPE_CHECKING:
    from pipeline.experiments.plan import Order, Plan

DEFAULT_OUT = "runs/experiments"


EXAMPLES = """\
examples:
  run_pipeline --stage experiment --list
  run_pipeline --stage experiment --table 4.5 4.6 --dry-run
  run_pipeline --stage experiment --figure 2.5 3.3 4.3 --budget smoke --seeds 1
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.epilog = EXAMPLES
    add = parser.add_argument
    add("--table", nargs="+", action="extend", default=[], metavar="N", help="tables of the thesis (--table 4.5 4.6)")
    add("--figure", nargs="+", action="extend", default=[], metavar="N", help="figures of the thesis (--figure 4.11)")
    add("--config", metavar="FILE", help="tables, budget and its changes from a file (configs/experiments/*.yaml)")
    add("--list", action="store_true", help="all experiments: purpose, needs, expected time")
    add("--data", metavar="DIR", help="a data set of yours (default: the synthetic world, made when needed)")
    add("--budget", choices=("smoke", "small", "paper"), help="how large and how long (default: small)")
    add("--seeds", type=int, metavar="N", help="trainings of each row (default: 3)")
    add("--rows", type=int, choices=(64, 32, 16, 8, 0), help="LiDAR rows, where a table has them")
    add("--out", metavar="DIR", help=f"folder of runs and tables (default: {DEFAULT_OUT})")
    add("--finished", action="store_true", help="run nothing: write the tables from the runs that are finished")
    add("--dry-run", action="store_true", help="say what would be run, how long it takes and what it writes")
    add("--json", action="store_true", help="print JSON instead of text")


def run(args: argparse.Namespace) -> int:
    """Lists, plans or runs; 0 when done."""
    from pipeline.experiments.plan import carry_out, make_plan

    if args.list:
        print(_listing(args))
        return 0
    order = read_order(args)
    plan = make_plan(order)
    if args.dry_run:
        print(_dry_run(plan, args.json))
        return 0
    if not args.finished:
        carry_out(plan, lambda text: print(text, file=sys.stderr, flush=True))
    _report(plan, args.json)
    return 0


def read_order(args: argparse.Namespace) -> Order:
    """Tables, budget and seeds of the options and of the configuration; options win. UsageError for none or unknown."""
    from pipeline.experiments.catalogue import find
    from pipeline.experiments.config import read_config
    from pipeline.experiments.further_rows import with_rows
    from pipeline.experiments.plan import Order
    from pipeline.run_folder.config import config_path

    config = read_config(config_path(args.config)) if args.config else None
    wanted = [("table", number) for number in args.table] + [("figure", number) for number in args.figure]
    if not wanted and config is not None:
        wanted = config.wanted
    if not wanted:
        raise UsageError("expected --table N, --figure N, --config FILE or --list; see --stage experiment --help")
    tables = tuple(find(kind, number) for kind, number in dict.fromkeys(wanted))
    if config is not None:
        tables = with_rows(tables, config.rows)
    if args.rows is not None:
        tables = tuple(table.with_lidar_rows(args.rows) for table in tables)
    data = Path(args.data).resolve() if args.data else None
    if data is not None and not data.is_dir():
        raise UsageError(f"--data {args.data}: expected the folder of a data set, there is none")
    seeds = args.seeds if args.seeds is not None else config.seeds if config else 3
    if seeds < 1:
        raise UsageError(f"--seeds: expected 1 or more, got {seeds}")
    budget = args.budget or (config.budget if config else "small")
    return Order(tables, Path(args.out or DEFAULT_OUT), budget, seeds, data, config.changes if config else None)


def _listing(args: argparse.Namespace) -> str:
    """All experiments with purpose, needs, and the time of a fresh folder."""
    from pipeline.experiments.catalogue import TABLES
    from pipeline.experiments.plan import Order, estimate_cost, make_plan

    budget, seeds = args.budget or "small", 3 if args.seeds is None else args.seeds
    rows: list[dict[str, Any]] = []
    for table in TABLES:
        plan = make_plan(Order((table,), Path(args.out or DEFAULT_OUT), budget, seeds))
        cost = estimate_cost(plan.all_runs())
        listed = sum(row.label not in plan.runs[table.name] for row in table.rows)
        rows.append(
            {
                "experiment": table.heading, "purpose": table.purpose, "needs": table.needs, "rows": len(table.rows),
                "listed only": listed, "runs": cost.runs, "core minutes": round(cost.seconds / 60, 1),
            }
        )  # fmt: skip
    if args.json:
        return json.dumps(rows, indent=1)
    lines = [f"budget {budget}, {seeds} seeds, on an empty folder; runs shared with other tables are done once", ""]
    for row in rows:
        lines.append(
            f"{row['experiment']:<12}{_minutes(60 * row['core minutes']):>9}  {row['runs']:>3} runs  {row['purpose']}"
        )
        only = f"; {row['listed only']} of {row['rows']} rows listed only" if row["listed only"] else ""
        lines.append(f"{'':<33}needs {row['needs']}{only}")
    return "\n".join(lines)


def _minutes(seconds: float) -> str:
    return (
        f"{seconds:.0f} s"
        if seconds < 90
        else f"{seconds / 60:.0f} min"
        if seconds < 7200
        else f"{seconds / 3600:.0f} h"
    )


def _dry_run(plan: Plan, as_json: bool) -> str:
    """Per table: runs done and left; in all: time and disk."""
    from pipeline.experiments.plan import estimate_cost

    left = {run.key for run in plan.open_runs()}
    cost = estimate_cost(plan.open_runs())
    tables = {}
    for table in plan.order.tables:
        keys = {run.key for runs in plan.runs[table.name].values() for run in runs}
        tables[table.heading] = {"runs": len(keys), "left": len(keys & left)}
    if as_json:
        record = {
            "tables": tables,
            "runs left": cost.runs,
            "core seconds": round(cost.seconds),
            "MB": round(cost.bytes / 1e6),
        }
        return json.dumps(record, indent=1)
    lines = [f"{name}: {counts['runs']} runs, {counts['left']} left" for name, counts in tables.items()]
    lines.append(f"in all {cost.runs} runs left: about {_minutes(cost.seconds)} on one core, {cost.bytes / 1e6:.0f} MB")
    return "\n".join(lines)


def _report(plan: Plan, as_json: bool) -> None:
    from pipeline.experiments import outputs
    from pipeline.experiments.plan import gather

    printed = []
    for table in plan.order.tables:
        result = gather(plan, table)
        written = outputs.write_outputs(plan.order, result, plan.order.out)
        if as_json:
            printed.append(outputs.as_json(plan.order, result))
            continue
        print(outputs.markdown(plan.order, result))
        print("written: " + ", ".join(str(path) for path in written) + "\n")
    if as_json:
        print(json.dumps(printed, indent=1))
