"""What the project promises to reach, and the table that says whether it does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.record import Measure, shown


@dataclass(frozen=True)
class Target:
    """A promise about one measured case.

    peer   "*": ours must be `limit` times better than the best peer; a label: than that peer; "": ours itself must
           reach `limit`, in the unit of the measure
    """

    room: str
    case: str
    limit: float
    peer: str = "*"

    def judged(self, measures: Sequence[Measure]) -> str:
        """One row of the table."""
        found = next((item for item in measures if item.case == self.case), None)
        if found is None:
            return f"| {self.room} | {self.case} | not measured | - | - | {self.limit:g} | - |"
        peer = found.best_peer if self.peer == "*" else self.peer
        theirs, ratio = "-", "-"
        if peer and peer in found.peers:
            theirs, ratio = f"{peer}: {shown(found.peers[peer], found.unit)}", f"{found.ratio(peer):.2f}"
        limit = f"ratio {self.limit:g}" if self.peer else shown(self.limit, found.unit)
        met = self.met(found)
        verdict = "-" if met is None else ("yes" if met else "**no**")
        cells = self.room, self.case, shown(found.ours, found.unit), theirs, ratio, limit, verdict
        return f"| {' | '.join(cells)} |"

    def met(self, found: Measure) -> bool | None:
        """Whether a measure keeps the promise; None when its peer was not there. Results that disagree never do."""
        if found.agree is False:
            return False
        if not self.peer:
            return found.ours >= self.limit if found.more_is_better else found.ours <= self.limit
        peer = found.best_peer if self.peer == "*" else self.peer
        if peer is None or peer not in found.peers:
            return None
        return found.ratio(peer) >= self.limit


EAGER = "plain eager torch"
TARGETS = (
    Target("SPEED", "TWISE-64, 352x1216, fp32", 3.0, EAGER),
    Target("SPEED", "bundled completer, 375x1242", 0.150, ""),
    Target("SPEED", "complete + augment + detect, 2 workers", 2.0, ""),
    Target("CLOUD", "four steps, nearest", 5.0),
    Target("CLOUD", "four steps, first", 5.0),
    Target("DETECTOR", "furthest points 16384 -> 4096, LiDAR", 1.0),
    Target("DETECTOR", "furthest points 50000 -> 4096, LiDAR", 1.0),
    Target("DETECTOR", "pointrcnn2: slowest operation of ours, beside the matrix products", 1.0),
    Target("AP", "3769 frames, first evaluation", 10.0, ""),
    Target("AP", "3769 frames, evaluation", 5.0, ""),
    Target("AP", "3769 frames, two values, beside the plain Python twin", 5.0),
    Target("AP", "3769 frames, peak memory", 500.0, ""),
    Target("BATCH", "augment, 2 workers", 1.7),
)


def summary(measures: Sequence[Measure], targets: Sequence[Target] = TARGETS) -> str:
    """Markdown table of all targets."""
    lines = ["| room | target | ours | peer | ratio | limit | met |", "|---|---|---:|---|---:|---:|---|"]
    return "\n".join(lines + [target.judged(measures) for target in targets]) + "\n"
