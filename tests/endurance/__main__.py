"""Kills at random moments: `python -m tests.endurance --minutes 60 [--scenario NAME] [--seed N]`, one line a kill.

A kill is SIGKILL, SIGTERM or SIGINT to one of the programs, or SIGKILL to one of their workers. Looked at afterwards:

- five seconds after its program has ended no process is alive;
- every result that lies there is what an undisturbed run makes: nothing half written, nothing different;
- the same command, given again, ends with exit code 0 and with all results: nothing lost, nothing too much;
- the ledgers hold every frame.

Exit code 1 when anything of this was wrong. Ray is tried where it is installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
import uuid
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from tests.endurance.scenarios import FRAMES, Scenario, scenarios
from tests.pipeline.left_behind import ENDS_WITHIN, marked, started

SIGNALS = ("SIGKILL", "SIGTERM", "SIGINT", "worker")
# A program that was asked to end finishes the frames in hand; a busy machine takes its time for that.
PATIENCE = 180.0


def finished(programs: list[subprocess.Popen[str]]) -> list[tuple[int, str]]:
    """Exit code and standard error of each; one that does not end is killed and has -9."""
    ends = []
    for program in programs:
        try:
            _, error = program.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            program.kill()
            _, error = program.communicate()
        ends.append((program.returncode, error))
    return ends


def run(scenario: Scenario, out: Path, mark: str) -> list[subprocess.Popen[str]]:
    """The programs of a scenario, started."""
    return [started(["pipeline.cli", *command], mark) for command in scenario.commands(out)]


@dataclass(frozen=True)
class Whole:
    """What a run that nobody kills ends with, and how many seconds it takes."""

    results: dict[str, bytes]
    tasks: set[tuple[str, str]]
    seconds: float


def undisturbed(scenario: Scenario, out: Path) -> Whole:
    """A run that nobody kills."""
    out.mkdir(exist_ok=True)
    start = time.monotonic()
    ends = finished(run(scenario, out, uuid.uuid4().hex))
    assert all(code == scenario.code for code, _ in ends), (scenario.name, ends)
    took = time.monotonic() - start
    whole = Whole(without_ledgers(scenario.results(out)), noted(out), took)
    shutil.rmtree(out)
    return whole


def without_ledgers(results: dict[str, bytes]) -> dict[str, bytes]:
    """Ledgers and configurations hold times and paths."""
    return {name: data for name, data in results.items() if not name.endswith((".sqlite", ".sqlite-journal", ".yaml"))}


def strike(mark: str, programs: list[subprocess.Popen[str]], how: str, moments: random.Random) -> bool:
    """Sends the signal; False when there was nobody to get it."""
    own = [program.pid for program in programs if program.poll() is None]
    targets = own
    if how == "worker":
        targets = [pid for pid, line in marked(mark).items() if "spawn_main" in line]
    if not targets:
        return False
    try:
        os.kill(moments.choice(targets), signal.SIGKILL if how == "worker" else signal.Signals[how])
    except ProcessLookupError:
        return False
    return True


def stayed(mark: str) -> list[str]:
    """The processes that are alive five seconds after their programs ended; they are killed then."""
    start = time.monotonic()
    while (left := marked(mark)) and time.monotonic() < start + ENDS_WITHIN:
        time.sleep(0.05)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    return list(left.values())


def noted(out: Path) -> set[tuple[str, str]]:
    """(stage, frame) in the ledgers of a run."""
    found: set[tuple[str, str]] = set()
    for path in out.glob("ledger*.sqlite"):
        connection = sqlite3.connect(path)
        found |= set(connection.execute("SELECT stage, frame FROM done"))
        connection.close()
    return found


def trial(scenario: Scenario, out: Path, whole: Whole, moments: random.Random) -> str | None:
    """One kill; "" when all was right, what was wrong, or None when nothing was hit."""
    out.mkdir()
    expected, mark, how = whole.results, uuid.uuid4().hex, moments.choice(SIGNALS)
    programs = run(scenario, out, mark)
    time.sleep(moments.uniform(0, whole.seconds))
    hit = strike(mark, programs, how, moments)
    wrong = []
    for code, error in finished(programs):
        if "Traceback" in error:
            wrong.append(f"exit {code} with a traceback: {error[-400:]}")
        elif code not in (0, 1, 2 if how == "worker" else 0, -9, 130, 143) and code not in (-15, -2):
            wrong.append(f"exit {code}: {error[-300:]}")
    alive = stayed(mark)
    wrong += [f"alive: {line}" for line in alive]
    half = [name for name, data in without_ledgers(scenario.results(out)).items() if expected.get(name) != data]
    if scenario.name not in ("export", "check", "synth"):  # whose folders appear as a whole, or are made anew
        wrong += [f"half written: {name}" for name in half]
    for command in scenario.commands(out):
        ((code, error),) = finished([started(["pipeline.cli", *command], mark)])
        if code != scenario.code:
            wrong.append(f"the rerun ended with {code}: {error[-400:]}")
    results = without_ledgers(scenario.results(out))
    if results != expected:
        names = sorted(name for name in {*results, *expected} if results.get(name) != expected.get(name))
        wrong.append(f"{len(names)} results lost, too many or different: {names[:3]}")
    if noted(out) != whole.tasks:
        wrong.append(f"{len(noted(out))} tasks in the ledgers instead of {len(whole.tasks)}")
    shutil.rmtree(out)
    return ("; ".join(wrong) and f"{how}: " + "; ".join(wrong)) if hit or wrong else None


def main() -> int:
    """Exit code 1 when anything was wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.endurance", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--scenario", action="append", help="default: all in turn")
    args = parser.parse_args()
    moments, kills, faults = random.Random(args.seed), Counter[str](), 0
    print(
        f"seed {args.seed}; {FRAMES} frames; Ray " + ("is" if importlib.util.find_spec("ray") else "not") + " installed"
    )
    end = time.monotonic() + args.minutes * 60
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as name:
        chosen = [item for item in scenarios(Path(name)) if not args.scenario or item.name in args.scenario]
        known: dict[str, Whole] = {}
        while time.monotonic() < end:
            scenario = chosen[sum(kills.values()) % len(chosen)]
            out = Path(name) / "out"
            if scenario.name not in known:
                known[scenario.name] = undisturbed(scenario, out)
            verdict = trial(scenario, out, known[scenario.name], moments)
            if verdict is None:
                continue
            kills[scenario.name] += 1
            faults += bool(verdict)
            print(
                f"{sum(kills.values()):4} {scenario.name:14} {'WRONG ' + verdict if verdict else 'right'}", flush=True
            )
    print(f"{sum(kills.values())} kills, {faults} wrong: {dict(kills)}", flush=True)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
