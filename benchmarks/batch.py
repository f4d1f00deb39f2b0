"""Frames per minute of each stage with one and more workers: `python -m benchmarks.batch [--data KITTI] --frames 24`.

Without --data it works on synthetic frames of KITTI's full size, made first (a few, each copied under several ids).

Each number of workers works into a fresh run folder through the command line. The rate of a stage is that of its
ledger rows, (frames - 1) / (last finish - first finish): starting the program and loading networks is not in it.
Run it on an idle machine with at least as many cores as workers.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.record import Measure, save


def stage_rates(out: Path) -> dict[str, tuple[float, float]]:
    """Stage -> (frames per minute, mean seconds of work per frame) of a finished run."""
    connection = sqlite3.connect(out / "ledger.sqlite")
    query = "SELECT stage, COUNT(*), MIN(finished_at), MAX(finished_at), AVG(seconds) FROM done GROUP BY stage"
    rows = connection.execute(query).fetchall()
    connection.close()
    return {stage: (60 * (count - 1) / max(last - first, 1e-9), mean) for stage, count, first, last, mean in rows}


def measured(options: list[str], workers: int, folder: Path, sizes: dict[str, float]) -> dict[str, tuple[float, float]]:
    """Rates of a run with this number of workers; the folder is removed again. `sizes` is told what it wrote."""
    out = folder / f"workers{workers}"
    command = [sys.executable, "-m", "pipeline.cli", *options, "--workers", str(workers), "--out", str(out)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    rates = stage_rates(out)
    sizes.update(megabytes(out, int(options[options.index("--frames") + 1].split(":")[1])))
    shutil.rmtree(out)
    return rates


def made_frames(root: Path, frames: int, different: int = 6) -> Path:
    """A KITTI folder of `frames` synthetic frames, `different` of them different."""
    from pipeline.simulation.synth import SynthSettings, write_dataset

    write_dataset(root, SynthSettings(frames=min(frames, different), seed=7), workers=2)
    for number in range(different, frames):
        for file in sorted(root.glob(f"training/*/{number % different:06d}.*")):
            shutil.copyfile(file, file.with_name(f"{number:06d}{file.suffix}"))
    return root


def megabytes(folder: Path, frames: int) -> dict[str, float]:
    """Size of the files in each folder below `folder`, per frame."""
    sizes = {}
    for part in sorted(folder.iterdir()):
        if part.is_dir():
            sizes[part.name] = sum(file.stat().st_size for file in part.rglob("*") if file.is_file()) / 1e6 / frames
    return sizes


def end_to_end(rates: dict[str, tuple[float, float]]) -> float:
    """Frames per second through all stages, which follow each other."""
    return 1 / sum(60 / rate for rate, _ in rates.values())


def measures_of(results: dict[int, dict[str, tuple[float, float]]]) -> list[Measure]:
    """Rates of each stage with more workers beside one, and of all stages together."""
    first, *others = results
    found = []
    for workers in others:
        for stage, (rate, _) in results[workers].items():
            peer = {f"{first} worker": results[first][stage][0]}
            found.append(Measure(f"{stage}, {workers} workers", rate, "frames/min", peer))
        peer = {f"{first} worker": end_to_end(results[first])}
        together = " + ".join(results[workers])
        found.append(Measure(f"{together}, {workers} workers", end_to_end(results[workers]), "frames/s", peer))
    return found


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.batch", description=__doc__)
    parser.add_argument("--data", type=Path, help="KITTI object folder; default: synthetic frames")
    parser.add_argument("--frames", type=int, default=24, help="from 2")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--stage", default="detect", help="the last stage to run")
    parser.add_argument("--folder", type=Path, help="where results are written for the time being")
    parser.add_argument("--set", action="append", default=[], help="as for run_pipeline")
    parser.add_argument("--json", help="write the figures to this file")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        data = args.data or made_frames(Path(folder) / "data", args.frames)
        options = ["--config", "kitti", "--stage", args.stage, "--data", str(data), "--frames", f"0:{args.frames}"]
        options += [word for change in args.set for word in ("--set", change)]
        sizes = megabytes(data / "training", args.frames) if args.data is None else {}
        results = {workers: measured(options, workers, Path(folder), sizes) for workers in args.workers}
    base = results[args.workers[0]]
    print("| stage | workers | frames per minute | of one frame, s | speed-up |\n|---|---:|---:|---:|---:|")
    for stage in base:
        for workers, rates in results.items():
            rate, seconds = rates[stage]
            print(f"| {stage} | {workers} | {rate:.1f} | {seconds:.3f} | {rate / base[stage][0]:.2f} |")
    print()
    for workers, rates in results.items():
        print(f"all stages, {workers} workers: {end_to_end(rates):.2f} frames/s")
    print("MB per frame: " + ", ".join(f"{name} {size:.2f}" for name, size in sizes.items()))
    print(f"peak memory of the largest process: {resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3:.0f} MB")
    save(args.json, measures_of(results))


if __name__ == "__main__":
    main()
