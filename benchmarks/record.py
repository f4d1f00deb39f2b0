"""What the benchmarks measured, as data: `python -m benchmarks` makes its summary, figure and baseline of it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.timing import Comparison, three_digits


@dataclass(frozen=True)
class Measure:
    """One figure of ours beside those of its peers.

    case   what was measured; names it in targets and baseline        unit  "s", "MB", or a rate ("frames/s")
    ours   seconds, megabytes or the rate                             peers label -> the same of a peer
    agree  whether every peer computed the same thing; None when that was not checked
    """

    case: str
    ours: float
    unit: str = "s"
    peers: dict[str, float] = field(default_factory=dict)
    agree: bool | None = None

    @property
    def more_is_better(self) -> bool:
        """Rates, unlike times and sizes."""
        return "/" in self.unit

    def ratio(self, peer: str) -> float:
        """How many times better ours is."""
        theirs = self.peers[peer]
        return self.ours / theirs if self.more_is_better else theirs / self.ours

    @property
    def best_peer(self) -> str | None:
        """The peer that comes nearest to ours or beats it."""
        return min(self.peers, key=self.ratio) if self.peers else None


@dataclass(frozen=True)
class Curve:
    """How a cost grows: seconds for each size."""

    name: str
    sizes: tuple[float, ...]
    seconds: tuple[float, ...]

    @property
    def slope(self) -> float:
        """Of log seconds over log size on the larger half of the sizes: 1 is linear."""
        half = max(0, len(self.sizes) // 2 - 1)
        return float(np.polyfit(np.log(self.sizes[half:]), np.log(self.seconds[half:]), 1)[0])


def measure_of(row: Comparison) -> Measure:
    """The medians of a paired timing."""
    agree = all(row.checks.values()) if row.checks else None
    return Measure(row.name, row.ours.median, "s", {peer.label: peer.median for peer in row.peers}, agree)


def save(path: str | Path | None, measures: Iterable[Measure], curves: Iterable[Curve] = ()) -> None:
    """Write both to a JSON file; nothing without a path."""
    if path is not None:
        values = {"measures": [asdict(item) for item in measures], "curves": [asdict(item) for item in curves]}
        Path(path).write_text(json.dumps(values, indent=1), encoding="utf-8")


def load(path: str | Path) -> tuple[list[Measure], list[Curve]]:
    """What `save` wrote; empty when there is no such file."""
    if not Path(path).is_file():
        return [], []
    values = json.loads(Path(path).read_text(encoding="utf-8"))
    curves = [Curve(one["name"], tuple(one["sizes"]), tuple(one["seconds"])) for one in values["curves"]]
    return [Measure(**one) for one in values["measures"]], curves


def ratios(measures: Sequence[Measure]) -> dict[str, float]:
    """'case | peer' -> how many times better ours is: what a baseline holds, since ratios outlive a machine."""
    return {f"{item.case} | {peer}": item.ratio(peer) for item in measures for peer in item.peers}


def got_worse(found: dict[str, float], baseline: dict[str, float], tolerance: float = 0.2) -> list[str]:
    """One line per ratio that fell by more than `tolerance` of its baseline."""
    return [
        f"{name}: {found[name]:.2f} times better than the peer, was {before:.2f}"
        for name, before in baseline.items()
        if name in found and found[name] < (1 - tolerance) * before
    ]


def shown(value: float, unit: str) -> str:
    """A figure for a table."""
    if not math.isfinite(value):
        return "-"
    if unit == "s":
        return f"{value:.2f} s" if value >= 1 else f"{value * 1e3:.3g} ms"
    return f"{three_digits(value)} {unit}"
