"""The frames of a data set as samples whose truth is the rings that were kept back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.base.errors import UsageError
from pipeline.data import Dataset, Frame

if TYPE_CHECKING:
    from completion.samples import DrawnSample
    from completion.types import DepthFrame

NEEDED = ("points", "calibration", "image")


@dataclass(frozen=True)
class RingSamples:
    """What `completion.train` reads for `train.truth: held_out_rings`; picklable for its worker processes.

    Raises UsageError for a data set without points, calibration or pictures, and for strides that keep no ring back.
    """

    dataset: Dataset
    beam_strides: tuple[int, ...]
    calibration_jitter: float = 0.0

    def __post_init__(self) -> None:
        require_rings(self.beam_strides)
        require_parts(self.dataset, NEEDED, " to hold rings out of")

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int, /) -> DrawnSample:
        from completion.samples import DrawnSample
        from pipeline.training.held_out_rings import HeldOutRings

        return DrawnSample(HeldOutRings.of(self.dataset[index], self.beam_strides, self.calibration_jitter))


def require_parts(dataset: Dataset, parts: Sequence[str], what_for: str) -> None:
    """Raises UsageError, ending in `what_for`, when the first frame lacks a part."""
    first = dataset[0]
    for part in parts:
        if not first.has(part):
            raise UsageError(f"{dataset.root}: frame {first.id} has no {part}{what_for}")


def require_rings(beam_strides: tuple[int, ...]) -> None:
    """Raises UsageError for strides that keep no ring back."""
    if not beam_strides or min(beam_strides) < 2:
        given = list(beam_strides)
        raise UsageError(f"train.beam_strides: held_out_rings expects numbers from 2, as [2, 4, 8], got {given}")


def held_out_validation(frame: Frame, beam_strides: tuple[int, ...]) -> DepthFrame:
    """A held-back frame at 16 rows of 64 (every 4th; the widest stride where that is none of them), no jitter."""
    from pipeline.training.held_out_rings import HeldOutRings

    return HeldOutRings.of(frame, beam_strides).every(4 if 4 in beam_strides else max(beam_strides))
