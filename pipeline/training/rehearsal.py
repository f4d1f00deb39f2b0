"""Frames with true depth beside one's own recordings, so that a network does not forget what scans do not teach."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from completion.samples import Sample, SampleSource

OWN_PER_REHEARSED = 2


@dataclass(frozen=True)
class Rehearsal:
    """Two samples of one's own recordings to one of `other`, each of them equally often; what `completion.train` reads.

    Held-out rings lie in one band of the picture and are noisy; dense depth shows every pixel, outlines among them.
    """

    own: SampleSource
    other: SampleSource

    @property
    def _rehearsed(self) -> int:
        """So many samples that both sources are seen whole."""
        return max(len(self.other), -(-len(self.own) // OWN_PER_REHEARSED))

    def __len__(self) -> int:
        return (OWN_PER_REHEARSED + 1) * self._rehearsed

    def __getitem__(self, index: int, /) -> Sample:
        if index < self._rehearsed:
            return self.other[index % len(self.other)]
        return self.own[(index - self._rehearsed) % len(self.own)]
