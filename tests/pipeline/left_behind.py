"""Kills the command line while its processes start or work, and looks for what stays: no process may, after 5 s.

`python -m tests.pipeline.left_behind` tries every command with every signal at several moments, one line each.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from dataclasses import dataclass
from pathlib import Path

from tests.pipeline.tiny_kitti import write_tiny_kitti

ROOT = Path(__file__).resolve().parent.parent.parent
MARK = "AUGLIDAR_TEST_MARK"
STARTS_WITHIN, ENDS_WITHIN = 120.0, 5.0
# More frames than are done before the kill.
FRAMES = 3000


def many_frames(root: Path) -> Path:
    """A KITTI folder of 3000 frames that share the files of the first."""
    write_tiny_kitti(root, 1)
    for path in sorted((root / "training").rglob("000000.*")):
        for index in range(1, FRAMES):
            os.link(path, path.with_name(f"{index:06d}{path.suffix}"))
    return root


def command(name: str, data: Path, out: Path) -> list[str]:
    """The arguments of a command that works in two processes for longer than a test lasts."""
    workers = ["--workers", "2"]
    if name == "synth":
        return ["--config", "synthetic", "--stage", "synth", "--out", str(out), "--set", "synth.frames=500", *workers]
    if name == "check":
        return ["--stage", "check", str(data), *workers]
    if name == "export":
        return ["--stage", "export", "--format", "openpcdet", "--data", str(data), "--out", str(out), *workers]
    words = ["--config", "kitti", "--stage", "complete", "--set", "completion.model=classical"]
    return [*words, "--data", str(data), "--out", str(out), *workers]


COMMANDS = ("synth", "check", "export", "frames")


@dataclass(frozen=True)
class End:
    """What became of a program: its exit code (None: it went on), and the processes that stayed."""

    code: int | None
    seconds: float
    stayed: tuple[str, ...]
    error: str


def marked(mark: str) -> dict[int, str]:
    """Process id -> command line of the processes whose environment holds the mark; zombies have none."""
    found = {}
    for folder in Path("/proc").iterdir():
        try:
            if folder.name.isdigit() and mark.encode() in (folder / "environ").read_bytes():
                found[int(folder.name)] = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()[:120]
        except OSError:
            continue
    return found


def started(arguments: list[str], mark: str) -> subprocess.Popen[str]:
    """`python -m ...` with the mark; it listens to SIGINT even where this process was started to ignore it (`&`)."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen(
            [sys.executable, "-m", *arguments],
            cwd=ROOT,
            env={**os.environ, MARK: mark, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
    finally:
        signal.signal(signal.SIGINT, before)


def killed(arguments: list[str], number: signal.Signals, after: float) -> End:
    """Starts a program, sends it a signal `after` seconds after its second worker is there, and waits for the end."""
    mark = uuid.uuid4().hex
    program = started(["pipeline.cli", *arguments], mark)
    deadline = time.monotonic() + STARTS_WITHIN
    while sum("spawn_main" in line for line in marked(mark).values()) < 2:
        assert program.poll() is None, program.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    time.sleep(after)
    assert program.poll() is None, program.communicate()
    program.send_signal(number)
    start = time.monotonic()
    # The parent finishes the frames in hand, or ends its pool; then its children have five seconds.
    while program.poll() is None and time.monotonic() < start + STARTS_WITHIN:
        time.sleep(0.02)
    took = time.monotonic() - start
    while marked(mark) and time.monotonic() < start + took + ENDS_WITHIN:
        time.sleep(0.02)
    stayed = marked(mark)
    for pid in stayed:
        os.kill(pid, signal.SIGKILL)
    _, error = program.communicate()
    return End(program.returncode, took, tuple(stayed.values()), error)


def main() -> int:
    """Exit code 1 when anything stayed or ended with another code than the signal's."""
    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        data = many_frames(Path(folder) / "data")
        for name in COMMANDS:
            for number in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT):
                for after in (0.0, 0.3, 4.0):
                    out = Path(folder) / "out"
                    end = killed(command(name, data, out), number, after)
                    expected = -number if number == signal.SIGKILL else 128 + number
                    right = end.code == expected and not end.stayed
                    wrong += not right
                    what = f"exit {end.code}, parent took {end.seconds:.1f} s, {len(end.stayed)} stayed"
                    verdict = "" if right else f"  WRONG {end.error[-300:]}"
                    print(f"{name:7} {number.name} after {after:.1f} s: {what}{verdict}", flush=True)
                    shutil.rmtree(out, ignore_errors=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
