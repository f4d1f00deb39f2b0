"""What an exporter gives back for one frame, and what the user chose."""

from __future__ import annotations

from dataclasses import dataclass, field

VIRTUAL = ("dense", "filtered")


@dataclass(frozen=True)
class Options:
    """Choices of an export.

    virtual  "dense": virtual points from every completed pixel; "filtered": the completed points of the augmented cloud
    compat   names of consumers' quirks to reproduce (each format lists its own)
    images   also write the colour images (PNG)
    """

    virtual: str = "dense"
    compat: frozenset[str] = frozenset()
    images: bool = False


@dataclass(frozen=True)
class Record:
    """Result of one frame: small, since all frames' results pass through one process.

    entries  (name of an index file, its entry as bytes) in order
    counts   name -> number, summed over the frames ("points", "boxes", ...)
    largest  name -> number, of which the largest over the frames is reported ("float16 error (m)")
    """

    entries: tuple[tuple[str, bytes], ...] = ()
    counts: dict[str, int] = field(default_factory=dict)
    largest: dict[str, float] = field(default_factory=dict)
