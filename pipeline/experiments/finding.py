"""A claim of the thesis and the orderings that test it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A claim in one sentence, and the orderings that test it: (kind, number, beginnings of the claims' texts).

    A number may end in "@16": the table at so many LiDAR rows.
    """

    claim: str
    tests: tuple[tuple[str, str, tuple[str, ...]], ...]
