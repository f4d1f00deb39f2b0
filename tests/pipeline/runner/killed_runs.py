"""Runs the command line in forked children and kills them: `python -m tests.pipeline.runner.killed_runs`.

A process of its own, which has imported everything and has no threads, so that a child costs milliseconds to start.
Prints one JSON line per kill. A moment is either a number of milliseconds, or the n-th of the steps at which a file or
a row is half done (`STEPS`), where the child kills itself.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sqlite3
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from pipeline.cli import main
from pipeline.runner.ledger import Ledger

# Between these calls of the runner a result is written but not flushed, flushed but not renamed, renamed but not noted
# in the ledger, or noted.
STEPS = ("before fsync", "before rename", "after rename", "before the ledger", "after the ledger")


def kill_at(step: str, count: int) -> None:
    """From now on this process kills itself at the `count`-th time it reaches `step`."""
    left = [count]

    def reached(name: str) -> None:
        if not step or name != step:
            return
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    def surrounded(call: Callable[..., Any], before: str, after: str) -> Callable[..., Any]:
        def called(*args: Any, **kwargs: Any) -> Any:
            reached(before)
            result = call(*args, **kwargs)
            reached(after)
            return result

        return called

    os.fsync = surrounded(os.fsync, "before fsync", "")
    os.replace = surrounded(os.replace, "before rename", "after rename")
    Ledger.record = surrounded(Ledger.record, "before the ledger", "after the ledger")  # type: ignore[method-assign]


def in_child(command: list[str], step: str, count: int, milliseconds: float) -> int:
    """The wait status of a child that runs `command` and is killed; milliseconds = 0 leaves the child to itself."""
    child = os.fork()
    if child == 0:
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        kill_at(step, count)
        os._exit(main(command))
    if milliseconds:
        time.sleep(milliseconds / 1000)
        os.kill(child, signal.SIGKILL)
    return os.waitpid(child, 0)[1]


def rows(out: Path) -> dict[str, float]:
    """stage/frame -> time it was finished; empty before there is a ledger."""
    path = out / "ledger.sqlite"
    if not path.exists():
        return {}
    connection = sqlite3.connect(path)
    try:
        found = connection.execute("SELECT stage, frame, finished_at FROM done")
        return {f"{stage}/{frame}": at for stage, frame, at in found}
    except sqlite3.OperationalError:  # killed before its tables were made
        return {}
    finally:
        connection.close()


def contents(out: Path) -> dict[str, bytes]:
    """Everything the frame stages wrote, by relative path, leftovers of a kill left out."""
    files = (path for folder in ("depth", "twin", "cloud") for path in (out / folder).glob("*") if path.is_file())
    return {str(path.relative_to(out)): path.read_bytes() for path in files if not path.name.startswith(".")}


def experiment(command: list[str], folder: Path, kills: int, seed: int) -> None:
    """An undisturbed run, then `kills` killed and continued ones."""
    whole = folder / "whole"
    with redirect_stdout(sys.stderr):
        main([*command, "--out", str(whole), "--frames", "0:2"])  # imports and compiles once for all children
    shutil.rmtree(whole)
    start = time.monotonic()
    if in_child([*command, "--out", str(whole)], "", 0, 0) != 0:
        raise SystemExit("the undisturbed run failed")
    took, expected, tasks = (time.monotonic() - start) * 1000, contents(whole), len(rows(whole))
    moments = random.Random(seed)
    for number in range(kills):
        out = folder / f"killed{number}"
        step = STEPS[number % len(STEPS)] if number % 2 else ""
        count = moments.randrange(1, tasks + 1)
        milliseconds = 0 if step else moments.uniform(1, took)
        status = in_child([*command, "--out", str(out)], step, count, milliseconds)
        while not os.WIFSIGNALED(status) and milliseconds > 1:
            # It ended before its moment, on a machine that became less busy: earlier.
            shutil.rmtree(out)
            milliseconds /= 2
            status = in_child([*command, "--out", str(out)], step, count, milliseconds)
        noted = rows(out)
        complete_files = {name for name, data in contents(out).items() if expected.get(name) == data}
        damaged = sorted(set(contents(out)) - complete_files)
        end = in_child([*command, "--out", str(out)], "", 0, 0)
        after = rows(out)
        result = {
            "moment": f"{step} {count}" if step else f"{milliseconds:.0f} ms",
            "killed": os.WIFSIGNALED(status),
            "noted": len(noted),
            "damaged": damaged,
            "ended": end,
            "redone": [task for task, at in noted.items() if after[task] != at],
            "tasks": len(after) - tasks,
            "same": contents(out) == expected,
        }
        print(json.dumps(result), flush=True)
        shutil.rmtree(out)


if __name__ == "__main__":
    experiment(sys.argv[4:], Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
