"""The thesis' claims beside the runs of an experiment folder: chapters 2 to 4 here, 5 in `chapter_5_findings`.

    python -m pipeline.experiments.findings --out runs/experiments --budget small --seeds 3

prints Markdown: per claim whether our runs confirm it, with the margins; `--into docs/findings.md` puts it between the
two marks of that page. `--chapter 5` does the same for detection, between marks of its own.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from auglidar_base.atomic import write_text
from pipeline.experiments.catalogue import find
from pipeline.experiments.finding import Finding
from pipeline.experiments.intervals import FAILS, HOLDS, UNKNOWN, Verdict
from pipeline.experiments.plan import Order, gather, make_plan

BEGIN, END = "<!-- findings: begin -->", "<!-- findings: end -->"
DETECTION_MARKS = ("<!-- detection findings: begin -->", "<!-- detection findings: end -->")
CONFIRMED, NOT_CONFIRMED, NOT_DECIDABLE = "confirmed", "not confirmed", "not decidable"


FINDINGS: tuple[Finding, ...] = (
    Finding(
        "A linear filter on depth invents points between two surfaces, on Depth Coefficients it does not (3.3).",
        (("figure", "3.3", ("coefficients put",)),),
    ),
    Finding(
        "Decoding all coefficients lowers RMSE, decoding three lowers tMAE (3.2).",
        (("table", "3.2", ("64R", "32R", "16R")),),
    ),
    Finding(
        "Depth Coefficients help only at input and output together (3.3).",
        (("table", "3.3", ("DC in", "CE out")),),
    ),
    Finding(
        "TWISE smears less than L2 and L1 (4.5).",
        (("table", "4.5", ("MultiStack: TWISE smears", "Res-18: TWISE smears")),),
    ),
    Finding(
        "TWISE has the lowest MAE and tMAE of all losses, on both backbones (4.5).",
        (("table", "4.5", ("MultiStack: TWISE has the lowest", "Res-18: TWISE has")),),
    ),
    Finding("L2 has the lower RMSE (4.5).", (("table", "4.5", ("MultiStack: L2", "Res-18: L2")),)),
    Finding(
        "Averaging both surfaces has a lower RMSE than choosing one; each surface alone is worse (4.6).",
        (("table", "4.6", ("the mean has a lower RMSE", "each surface alone")),),
    ),
    Finding(
        "RMSE prefers mixed depth: the mean of both surfaces beats the learned sigma in it (4.6).",
        (("table", "4.6", ("the mean has the",)),),
    ),
    Finding("Learned sigma is best, and needs colour (4.6).", (("table", "4.6", ("learned sigma", "colour lowers")),)),
    Finding("gamma 2 is a compromise (4.7).", (("table", "4.7", ("gamma",)),)),
    Finding(
        "TWISE suffers least from fewer LiDAR rows, down to none (4.8).",
        (("table", "4.8", ("64R", "32R", "16R", "8R", "0R")),),
    ),
    Finding("Large errors lie at boundaries (4.2).", (("table", "4.2", ("MAE", "tMAE")),)),
    Finding(
        "MAE ranks methods alike on clean and on semi-dense ground truth, RMSE does not (4.11).",
        (("figure", "4.11", ("MultiStack: MAE", "MultiStack: RMSE", "Res-18: MAE", "Res-18: RMSE")),),
    ),
    Finding("On clean ground truth TWISE's RMSE is no worse than L2's (4.11).", (("figure", "4.11", ("on clean",)),)),
)  # fmt: skip


def summary(verdicts: Sequence[Verdict]) -> str:
    """Confirmed when every ordering holds, not confirmed when one does not, else not decidable."""
    found = [verdict.verdict for verdict in verdicts]
    if FAILS in found:
        return NOT_CONFIRMED
    return CONFIRMED if found and all(verdict == HOLDS for verdict in found) else NOT_DECIDABLE


def markdown(out: Path, budget: str, seeds: int, findings: Sequence[Finding] = FINDINGS) -> str:
    """All findings with their evidence, from the finished runs in `out`."""
    lines = ["| claim of the thesis | in our runs |", "|---|---|"]
    details = []
    for finding in findings:
        verdicts = _verdicts(finding, out, budget, seeds)
        lines.append(f"| {finding.claim} | **{summary(verdicts)}**{_counts(verdicts)} |")
        if all(verdict.verdict == UNKNOWN for verdict in verdicts):
            continue
        details += [f"### {finding.claim}", "", f"**{summary(verdicts)[0].upper()}{summary(verdicts)[1:]}.**", ""]
        details += [f"- {v.text}: {v.verdict}" + (f" ({v.evidence})" if v.evidence else "") for v in verdicts]
        details.append("")
    return "\n".join([*lines, "", *details])


def _counts(verdicts: Sequence[Verdict]) -> str:
    if all(verdict.verdict == UNKNOWN for verdict in verdicts):
        return ": not run"
    holds = sum(verdict.verdict == HOLDS for verdict in verdicts)
    fails = sum(verdict.verdict == FAILS for verdict in verdicts)
    return f": {holds} of {len(verdicts)} orderings hold, {fails} do not"


def _verdicts(finding: Finding, out: Path, budget: str, seeds: int) -> list[Verdict]:
    found = []
    for kind, number, beginnings in finding.tests:
        number, _, rows = number.partition("@")
        table = find(kind, number)
        table = table.with_lidar_rows(int(rows)) if rows else table
        plan = make_plan(Order((table,), out, budget, seeds))
        found += [v for v in gather(plan, table).verdicts if v.text.startswith(beginnings)]
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """The command of the file's first lines."""
    parser = argparse.ArgumentParser(description="The thesis' claims beside the runs of an experiment folder.")
    parser.add_argument("--out", type=Path, default=Path("runs/experiments"))
    parser.add_argument("--budget", choices=("smoke", "small", "paper"), default="small")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--chapter", choices=("4", "5"), default="4", help="4: chapters 2 to 4")
    parser.add_argument("--into", type=Path, help="page whose part between the marks is replaced")
    options = parser.parse_args(arguments)
    from pipeline.experiments import chapter_5_findings

    choices = {"4": (FINDINGS, (BEGIN, END)), "5": (chapter_5_findings.FINDINGS, DETECTION_MARKS)}
    chosen, (begin, end) = choices[options.chapter]
    text = markdown(options.out, options.budget, options.seeds, chosen)
    if options.into is None:
        print(text)
        return
    page = options.into.read_text(encoding="utf-8")
    if begin not in page or end not in page:
        parser.error(f"--into {options.into}: expected a page with {begin} and {end}")
    write_text(options.into, page.partition(begin)[0] + f"{begin}\n\n{text}\n{end}" + page.partition(end)[2])


if __name__ == "__main__":
    main()
