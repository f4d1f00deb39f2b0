"""`python -m benchmarks` (or `make bench`): every comparison with peers in one run, written to benchmarks/RESULTS.md.

Run it on an idle machine. Each part is a module of its own with more options: `python -m benchmarks.ops --help`.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

RESULTS = Path(__file__).parent / "RESULTS.md"
# title, module and arguments, threads
PARTS = (
    ("Point operations", ("benchmarks.ops", "--threads", "1", "--repeats", "7"), "1"),
    ("Point-cloud stage", ("benchmarks.pointcloud",), ""),
    ("KITTI AP, 3769 frames", ("benchmarks.ap_speed", "--twin", "3769"), "1"),
    (
        "PointRCNN2 forward, two threads",
        ("benchmarks.detector_profile", "--preset", "pointrcnn2", "--threads", "2"),
        "",
    ),
    ("Sparse convolution", ("benchmarks.sparse_conv", "--repeats", "3"), "1"),
)


def run_part(command: tuple[str, ...], threads: str) -> str:
    """What `python -m COMMAND` prints. Raises CalledProcessError when it fails."""
    environment = dict(os.environ) | ({"OMP_NUM_THREADS": threads} if threads else {})
    done = subprocess.run(
        [sys.executable, "-m", *command], env=environment, text=True, stdout=subprocess.PIPE, check=True
    )
    text = done.stdout.strip()
    return text if "|" in text else f"```\n{text}\n```"


def main() -> int:
    """Runs all parts and writes the results."""
    load = os.getloadavg()[0]
    sections = [f"# Benchmarks\n\n{platform.machine()}, {os.cpu_count()} cores, load {load:.1f} at the start.\n"]
    if load > 0.5:
        print(f"the machine is busy (load {load:.1f}): ratios may be off", file=sys.stderr)
    for title, command, threads in PARTS:
        print(f"{title} ...", file=sys.stderr, flush=True)
        shown = (f"OMP_NUM_THREADS={threads} " if threads else "") + "python -m " + " ".join(command)
        sections.append(f"## {title}\n\n`{shown}`\n\n{run_part(command, threads)}\n")
    RESULTS.write_text("\n".join(sections), encoding="utf-8")
    print(RESULTS)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
