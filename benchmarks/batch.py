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
import time
from pathlib import Path

from benchmarks.record import Measure, save
from pipeline.run_folder.frame_outputs import Written
from pipeline.runner.jobs import Outcome, Task
from pipeline.runner.ledger import Ledger


def stage_rates(out: Path) -> dict[str, tuple[float, float]]:
    """Stage -> (frames per minute, mean seconds of work per frame) of a finished run."""
    connection = sqlite3.connect(out / "ledger.sqlite")
    query = (
        "SELECT stage, COUNT(*), MIN(finished_at), MAX(finished_at), AVG(seconds) FROM done GROUP BY stage ORDER BY 3"
    )
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
    from pipeline.simulation.synth import SynthSettings
    from pipeline.simulation.writers import write_dataset

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


# The machines of `million_frames`: cores each, GB/s of the disk they share, cores that a GPU is worth.
CORES, SHARED_DISK, GPU_GAIN = 16, 1.0, 20.0


def ledger_row(rows: int = 200) -> float:
    """Seconds that one finished frame takes to be written into a ledger, durably, in the folder for temporary files."""
    with tempfile.TemporaryDirectory() as folder:
        ledger = Ledger(Path(folder) / "ledger.sqlite")
        start = time.perf_counter()
        for number in range(rows):
            ledger.record(Outcome(Task("augment", f"{number:06d}"), {"cloud": Written(10**6, "0" * 64)}, 1.0), "0" * 64)
        seconds = (time.perf_counter() - start) / rows
        ledger.close()
    return seconds


def million_frames(rates: dict[str, tuple[float, float]], read: float, written: float) -> str:
    """Markdown: hours that a million frames take on so many machines, by the model of docs/scaling.md.

    rates    of one worker      read, written  MB per frame
    """
    work = {stage: 60 / rate for stage, (rate, _) in rates.items()}
    ledger = len(work) * ledger_row() * 1e6 / 3600
    lines = ["| machines | cores, h | with a GPU each, h | shared disk, h | one ledger, h | decides: cores, GPUs |"]
    lines.append("|---:|---:|---:|---:|---:|---|")
    disk = (2 * read + written) / SHARED_DISK / 1e3 * 1e6 / 3600
    for machines in (1, 10, 100, 1000):
        cores = sum(work.values()) * 1e6 / (machines * CORES) / 3600
        networks = work.get("complete", 0.0) + work.get("detect", 0.0)
        others = (sum(work.values()) - networks) / CORES
        gpu = max(networks / GPU_GAIN, others) * 1e6 / machines / 3600
        decides = [
            max((hours, name) for hours, name in ((own, kind), (disk, "disk"), (ledger, "ledger")))[1]
            for own, kind in ((cores, "cores"), (gpu, "GPUs"))
        ]
        lines.append(f"| {machines} | {cores:.1f} | {gpu:.1f} | {disk:.1f} | {ledger:.1f} | {', '.join(decides)} |")
    return "\n".join(lines)


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
    written = sum(sizes.get(name, 0.0) for name in ("depth", "twin", "cloud", "detections"))
    read = sum(sizes.get(name, 0.0) for name in ("image_2", "velodyne", "calib"))
    print("MB per frame: " + ", ".join(f"{name} {size:.2f}" for name, size in sizes.items()))
    print(f"peak memory of the largest process: {resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3:.0f} MB")
    if read:
        assumed = f"{CORES} cores a machine, {SHARED_DISK:g} GB/s of shared disk, a GPU worth {GPU_GAIN:g} cores"
        print(f"\na ledger row takes {1e3 * ledger_row():.2f} ms; a million frames, assumed {assumed}:\n")
        print(million_frames(base, read, written))
    save(args.json, measures_of(results))


if __name__ == "__main__":
    main()
