"""Frames per minute of each stage with one and more workers: `python -m benchmarks.batch --data KITTI --frames 24`.

Each number of workers works into a fresh run folder through the command line. The rate of a stage is that of its
ledger rows, (frames - 1) / (last finish - first finish): starting the program and loading networks is not in it.
Run it on an idle machine with at least as many cores as workers.
"""

from __future__ import annotations

import argparse
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from pathlib import Path


def stage_rates(out: Path) -> dict[str, tuple[float, float]]:
    """Stage -> (frames per minute, mean seconds of work per frame) of a finished run."""
    connection = sqlite3.connect(out / "ledger.sqlite")
    query = "SELECT stage, COUNT(*), MIN(finished_at), MAX(finished_at), AVG(seconds) FROM done GROUP BY stage"
    rows = connection.execute(query).fetchall()
    connection.close()
    return {stage: (60 * (count - 1) / max(last - first, 1e-9), mean) for stage, count, first, last, mean in rows}


def measured(options: list[str], workers: int, folder: Path) -> dict[str, tuple[float, float]]:
    """Rates of a run with this number of workers; the folder is removed again."""
    out = folder / f"workers{workers}"
    command = [sys.executable, "-m", "pipeline.cli", *options, "--workers", str(workers), "--out", str(out)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    rates = stage_rates(out)
    shutil.rmtree(out)
    return rates


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.batch", description=__doc__)
    parser.add_argument("--data", required=True, help="KITTI object folder")
    parser.add_argument("--frames", type=int, default=24, help="from 2")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--stage", default="detect", help="the last stage to run")
    parser.add_argument("--folder", type=Path, help="where results are written for the time being")
    parser.add_argument("--set", action="append", default=[], help="as for run_pipeline")
    args = parser.parse_args()
    options = ["--config", "kitti", "--stage", args.stage, "--data", args.data, "--frames", f"0:{args.frames}"]
    options += [word for change in args.set for word in ("--set", change)]
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        results = {workers: measured(options, workers, Path(folder)) for workers in args.workers}
    base = results[args.workers[0]]
    print("| stage | workers | frames per minute | of one frame, s | speed-up |\n|---|---:|---:|---:|---:|")
    for stage in base:
        for workers, rates in results.items():
            rate, seconds = rates[stage]
            print(f"| {stage} | {workers} | {rate:.1f} | {seconds:.3f} | {rate / base[stage][0]:.2f} |")


if __name__ == "__main__":
    main()
