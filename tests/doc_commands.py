"""The commands of the documentation, and which of them are not run by the tests, with the reason.

    python -m tests.doc_commands        prints the list

Every command of a fenced block is run by tests/test_docs_commands.py on tiny data, in the order of STORY, unless a rule
of NOT_RUN matches it. A page that is not in STORY may only hold commands that such a rule matches.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([*ROOT.glob("docs/*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"])
FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
PROGRAMS = ("run_pipeline", "make", "python", "pip", "ray", "srun", "torchrun", "scripts/")

# The order in which a reader would come to them: later pages use what earlier ones made.
STORY = (
    "start.md", "kitti.md", "README.md", "index.md", "virtual-points.md", "other-networks.md", "own-methods.md",
    "noise.md", "cluster.md", "report.md", "doctor.md", "data.md", "evaluation.md", "export.md", "train.md",
)  # fmt: skip

# Pattern of a command -> why it is not run here.
NOT_RUN = {
    r"^run_pipeline$|synth\.frames=4 |^make ": "takes minutes; CI runs the demo and the tests on their own",
    r"^pip install|^ray |RAY_ADDRESS|^srun|^torchrun": "installs, or needs several machines: tests/pipeline/runner",
    r"--stage train|--stage synth|runs/(trained|adapted)": "trains for minutes to hours: tests/pipeline/training",
    r"--stage experiment": "a study of hours; plans and smoke runs: tests/pipeline/experiments",
    r"--stage bench|-m benchmarks|-m timeit": "measures for minutes: tests/pipeline/benchmark, tests/benchmarks",
    r"\.(tar|pth|pt) |result\.pkl|/(twise|pointrcnn|penet)": "needs a published file: test_importers.py",
    r"--leakage": "needs KITTI's devkit: tests/pipeline/check/test_leakage.py",
    r"^python -m pytest|^scripts/test|-m tests\.": "tests of their own",
    r"^python -m pipeline\.|^python (docs|scripts)/": "makes figures, pages or weights",
}


def blocks(page: Path) -> Iterator[str]:
    """Fenced shell blocks, continuation lines joined; loops over words written out."""
    for found in FENCE.finditer(page.read_text(encoding="utf-8")):
        if found.group(1) in ("sh", "bash", "console", ""):
            yield re.sub(
                r"for (\w+) in ([^;]+); do\n(.*?)\ndone", _unrolled, found.group(2).replace("\\\n", " "), flags=re.S
            )


def _unrolled(loop: re.Match[str]) -> str:
    name, words, body = loop.groups()
    return "\n".join(body.replace(f"${name}", word) for word in words.split())


def commands(page: Path) -> list[str]:
    """The command lines of a page, without comments."""
    lines = [line.strip() for block in blocks(page) for line in block.splitlines()]
    starts = tuple(PROGRAMS)
    kept = [line for line in lines if re.sub(r"^(\w+=\S+ )+", "", line).startswith(starts)]
    return [
        shlex.join(shlex.split(line, comments=True)) if "$" not in line else line.split(" #")[0].strip()
        for line in kept
    ]


def reason_not_run(command: str) -> str | None:
    """Why the tests leave a command out, or None when they run it."""
    return next((why for pattern, why in NOT_RUN.items() if re.search(pattern, command)), None)


def main() -> None:
    for page in PAGES:
        for command in commands(page):
            reason = reason_not_run(command)
            print(f"{page.name}: {command}\n    {'run' if reason is None else 'not run: ' + reason}")


if __name__ == "__main__":
    main()
