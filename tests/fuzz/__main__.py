"""Long fuzzing runs: `python -m tests.fuzz --minutes 10 [--target label]`, CPU minutes per target, one line each.

Memory of the process is limited, so that a reader which takes too much ends with a MemoryError; a reader that computes
for a minute on one file ends the program with a stack trace. Readers of pickles and arrays
work in a process of their own (`child.py`), so that a crash is a find, and may take 1 GB. All of these, and every error
that is no refusal, are finds: the file is kept in the folder of `--finds`.
"""

from __future__ import annotations

import argparse
import faulthandler
import hashlib
import resource
import signal
import sys
import time
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, seed, settings

from tests.fuzz.targets import TARGETS, try_file

EXAMPLES_PER_ROUND = 500
# CPU time: on a busy machine a process may wait for a minute without any fault of a reader.
HANG_SECONDS = 60.0


def fuzz(name: str, minutes: float, finds: Path) -> bool:
    """Tries files on one target until its CPU time is used up or one is found; True when nothing is found."""
    counts = {True: 0, False: 0}
    last = [b""]

    def tried(data: bytes) -> None:
        last[0] = data
        signal.setitimer(signal.ITIMER_PROF, HANG_SECONDS)
        counts[try_file(name, data)] += 1

    faulthandler.register(signal.SIGPROF, chain=True)  # a stack trace, then the signal's own end of the program
    start, rounds = time.process_time(), 0
    try:
        while time.process_time() - start < minutes * 60:
            limits = settings(
                max_examples=EXAMPLES_PER_ROUND,
                deadline=None,
                database=None,
                phases=[Phase.generate, Phase.shrink],
                suppress_health_check=list(HealthCheck),
            )
            seed(rounds)(limits(given(TARGETS[name].files())(tried)))()
            rounds += 1
    except Exception as error:  # whatever a reader raises is what is looked for
        finds.mkdir(parents=True, exist_ok=True)
        path = finds / f"{name}-{hashlib.sha256(last[0]).hexdigest()[:12]}"
        path.write_bytes(last[0])
        print(f"{name}: FOUND {type(error).__name__}: {' '.join(str(error).split())[:300]} -> {path}", flush=True)
        return False
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    used = (time.process_time() - start) / 60
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{name}: {sum(counts.values())} files ({counts[True]} taken, {counts[False]} refused), "
        f"{used:.1f} CPU minutes, peak {peak:.0f} MB, nothing found",
        flush=True,
    )
    return True


def main() -> int:
    """Exit code 1 when something was found."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="CPU minutes per target")
    parser.add_argument("--target", choices=tuple(TARGETS), action="append", help="default: all")
    parser.add_argument("--memory-gb", type=float, default=6.0, help="address space of the process")
    parser.add_argument("--finds", type=Path, default=Path("fuzz-finds"), help="where found files are kept")
    args = parser.parse_args()
    limit = int(args.memory_gb * 1e9)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    clean = [fuzz(name, args.minutes, args.finds) for name in args.target or TARGETS]
    return 0 if all(clean) else 1


if __name__ == "__main__":
    sys.exit(main())
