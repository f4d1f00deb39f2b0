"""`python -m benchmarks` (or `make bench`): every comparison with peers in one run.

Writes benchmarks/RESULTS.md (targets first) and RESULTS.png, and compares the ratios with those that
benchmarks/baseline.json holds for this kind of machine: exit code 1 when a result disagrees with its peer's or a ratio
fell by more than a fifth. Run it on an idle machine.
Each part is a module of its own with more options: `python -m benchmarks.ops --help`.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.figures import draw
from benchmarks.record import Curve, Measure, got_worse, load, ratios
from benchmarks.targets import summary

FOLDER = Path(__file__).parent
BASELINE = FOLDER / "baseline.json"


@dataclass(frozen=True)
class Part:
    """A title, the module with its arguments (and those of a quick run), and the threads of OpenMP, "" for all."""

    title: str
    command: tuple[str, ...]
    quick: tuple[str, ...]
    threads: str = ""


PARTS = (
    Part("Completion networks", ("completion",), ("--quick", "--repeats", "1")),
    Part("NLSPN", ("nlspn",), ("--quick", "--repeats", "1")),
    Part("Point-cloud stage", ("pointcloud",), ("--repeats", "1"), "1"),
    Part("Point operations", ("ops", "--threads", "1", "--repeats", "7"), ("--repeats", "1"), "1"),
    Part("PointRCNN2 forward", ("detector_profile", "--preset", "pointrcnn2", "--threads", "2"), ("--preset", "small")),
    Part("Small detector forward", ("detector_profile", "--preset", "small", "--threads", "2"), ("--repeats", "1")),
    Part("Sparse convolution", ("sparse_conv", "--repeats", "3"), ("--repeats", "1"), "1"),
    Part("KITTI AP, 3769 frames", ("ap_speed", "--twin", "3769"), ("--frames", "20", "--twin", "20"), "1"),
    Part(
        "Batches, 1 and 2 workers",
        ("batch", "--frames", "24", "--set", "completion.backend=auto"),
        ("--frames", "4"),
        "1",
    ),
    Part("Training", ("training", "--steps", "6"), ("--quick",), "1"),
    Part("Growth of costs", ("scaling",), ("--quick", "--repeats", "1"), "1"),
)


def run_part(part: Part, quick: bool, folder: Path) -> tuple[str, list[Measure], list[Curve]]:
    """A section of the results, and its figures. A part that fails says so in its section."""
    command = [*part.command, *(part.quick if quick else ())]
    environment = dict(os.environ) | ({"OMP_NUM_THREADS": part.threads} if part.threads else {})
    figures = folder / f"{part.command[0]}-{len(list(folder.iterdir()))}.json"
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{command[0]}", *command[1:], "--json", str(figures)],
        env=environment,
        text=True,
        capture_output=True,
    )
    text = done.stdout.strip()
    if done.returncode:
        print(done.stderr[-2000:], file=sys.stderr)
        text += f"\n\nended with code {done.returncode}: {(done.stderr.strip().splitlines() or [''])[-1]}"
    shown = (f"OMP_NUM_THREADS={part.threads} " if part.threads else "") + "python -m benchmarks." + " ".join(command)
    body = text if "|" in text else f"```\n{text}\n```"
    print(f"{part.title}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    return f"## {part.title}\n\n`{shown}`\n\n{body}\n", *load(figures)


def machine() -> str:
    """Processor, cores and load."""
    when = time.strftime("%Y-%m-%d", time.gmtime())
    load = os.getloadavg()[0]
    python = platform.python_version()
    return f"{when}, {processor('model name')}, {os.cpu_count()} cores, load {load:.1f} at the start, Python {python}."


def kind_of_machine() -> str:
    """What a baseline belongs to: processor, cores and widest vector instructions; ratios depend on them."""
    flags = processor("flags").split()
    vectors = next((name for name in ("avx512f", "avx2", "avx") if name in flags), "no AVX")
    return f"{processor('model name')}, {os.cpu_count()} cores, {vectors}"


def processor(field: str) -> str:
    """A field of the first processor; the architecture where the system does not tell."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text(encoding="utf-8").splitlines() if information.is_file() else []
    return next((line.split(":")[1].strip() for line in lines if line.startswith(field)), platform.machine())


def read_baselines(path: Path) -> dict[str, dict[str, float]]:
    """Kind of machine -> ratios kept there by --save-baseline."""
    kept: dict[str, dict[str, float]] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return kept


def agreement(kind: str, known: bool) -> str:
    """What is said when no ratio got worse."""
    if known:
        return "No ratio fell by more than a fifth of the baseline's."
    return f"No baseline of this kind of machine ({kind}) to compare with; --save-baseline keeps one."


def main() -> int:
    """Runs the parts and writes the results."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes: whether everything runs, not how fast")
    parser.add_argument("--only", nargs="+", help="these modules only, e.g. ops completion")
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder of RESULTS.md and RESULTS.png")
    parser.add_argument("--save-baseline", action="store_true", help="keep the ratios of this run as the baseline")
    options = parser.parse_args()
    if options.quick and options.out == FOLDER:
        parser.error("--quick measures nothing worth keeping: give another --out")
    head = machine()
    if os.getloadavg()[0] > 0.5:
        print(f"the machine is busy (load {os.getloadavg()[0]:.1f}): ratios may be off", file=sys.stderr)
    sections: list[str] = []
    measures: list[Measure] = []
    curves: list[Curve] = []
    worse: list[str] = []
    wrong: list[str] = []
    kind, baselines = kind_of_machine(), read_baselines(BASELINE)
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for part in PARTS:
            if options.only is None or part.command[0] in options.only:
                section, found, grown = run_part(part, options.quick, Path(folder))
                sections.append(section)
                measures += found
                curves += grown
                worse = got_worse(ratios(measures), baselines.get(kind, {}))
                wrong = [item.case for item in measures if item.agree is False]
                # After every part: a run that is stopped leaves what it measured.
                compared = worse or [agreement(kind, kind in baselines)]
                text = results(head, measures, compared, wrong, sections)
                (options.out / "RESULTS.md").write_text(text, encoding="utf-8")
    draw(measures, curves, options.out / "RESULTS.png")
    if options.save_baseline:
        baselines[kind] = ratios(measures)
        BASELINE.write_text(json.dumps(baselines, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    print(options.out / "RESULTS.md")
    print("\n".join([*worse, *(f"{case}: results disagree" for case in wrong)]))
    return 1 if worse or wrong else 0


def results(head: str, measures: list[Measure], compared: list[str], wrong: list[str], sections: list[str]) -> str:
    """RESULTS.md; `compared` says what became of the baseline's ratios."""
    verdict = "\n".join(f"- {line}" for line in compared)
    doubts = "".join(f"\n- {case}: **results disagree**" for case in wrong)
    picture = "![Times better than each best peer, and how costs grow](RESULTS.png)"
    top = f"# Benchmarks\n\n{head}\n\n## Targets\n\n{summary(measures)}\n{verdict}{doubts}\n\n{picture}\n"
    return "\n".join([top, *sections])


if __name__ == "__main__":
    raise SystemExit(main())
