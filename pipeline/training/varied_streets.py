"""Synthetic frames that look different every time they are drawn: photographs on their surfaces, uneven ground, and as
truth what a LiDAR would measure or what the renderer knows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.data import Dataset, Frame
from pipeline.training.beam_subsampling import RandomBeamSubsampling
from pipeline.training.held_out_rings import HeldOutRings
from pipeline.training.photographs import read_photographs
from pipeline.training.relief import relief
from pipeline.training.ring_samples import require_parts, require_rings
from pipeline.training.surfaces import Surfaces, find_surfaces, retextured

if TYPE_CHECKING:
    from completion.samples import DrawnSample
    from completion.types import DepthFrame
    from pipeline.run_folder.config import TrainConfig

NEEDED = ("points", "calibration", "image", "target_depth", "semantics", "instances")
# Shares of drawings: with photographs, and for truth "both" with rings as truth. A scan says what a LiDAR sees of an
# edge; dense depth alone shows outlines between the rings and what lies above them.
PHOTOGRAPHED, BY_RINGS = 0.6, 0.75

Drawing = Callable[[np.random.Generator], "DepthFrame"]


@dataclass(frozen=True)
class VariedStreets:
    """What `completion.train` reads for `train.photographs` and `train.relief`; picklable for its worker processes.

    by_rings  share of drawings whose truth is the rings that the strides keep back; the others' is dense
    """

    dataset: Dataset
    by_rings: float
    beam_strides: tuple[int, ...]
    calibration_jitter: float = 0.0
    photographs: Path | None = None
    relief: float = 0.0

    @classmethod
    def of(cls, dataset: Dataset, section: TrainConfig) -> VariedStreets:
        """Raises UsageError for a data set without the parts of a synthetic frame, strides that `truth` cannot use, and
        a folder without photographs."""
        require_parts(
            dataset, NEEDED, "; train.photographs, train.relief and train.truth=both are for synthetic frames"
        )
        if section.truth != "depth":
            require_rings(section.beam_strides)
        photographs = None if section.photographs is None else Path(section.photographs)
        if photographs is not None:
            read_photographs(photographs)
        by_rings = {"depth": 0.0, "held_out_rings": 1.0, "both": BY_RINGS}[section.truth]
        return cls(dataset, by_rings, section.beam_strides, section.calibration_jitter, photographs, section.relief)

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int, /) -> DrawnSample:
        from completion.samples import DrawnSample

        frame = self.dataset[index]
        dense = RandomBeamSubsampling.of(frame, tuple({1, *self.beam_strides}), self.calibration_jitter)
        rings = HeldOutRings.of(frame, self.beam_strides, self.calibration_jitter) if self.by_rings else None
        picture = self._pictures(frame)

        def draw(rng: np.random.Generator) -> DepthFrame:
            by_rings = rings is not None and rng.random() < self.by_rings
            drawn = rings(rng) if by_rings and rings is not None else _with_dense_truth(frame, dense(rng))
            return self._varied(drawn, frame, picture(rng), rng)

        return DrawnSample(draw)

    def _pictures(self, frame: Frame) -> Callable[[np.random.Generator], NDArray[np.uint8]]:
        """Draws the frame's picture; its surfaces are found once, however many crops it gives."""
        if self.photographs is None:
            return lambda rng: frame.image
        tiles = read_photographs(self.photographs)

        @cache
        def surfaces() -> Surfaces:
            return find_surfaces(frame.target_depth, frame.semantics, frame.instances, frame.calibration.K)

        def picture(rng: np.random.Generator) -> NDArray[np.uint8]:
            return retextured(frame.image, surfaces(), tiles, rng) if rng.random() < PHOTOGRAPHED else frame.image

        return picture

    def _varied(
        self, drawn: DepthFrame, frame: Frame, image: NDArray[np.uint8], rng: np.random.Generator
    ) -> DepthFrame:
        from completion.types import DepthFrame

        sparse, target, K = drawn.sparse, drawn.target, frame.calibration.K
        assert target is not None
        if rng.random() < self.relief:
            factor = relief(frame.target_depth, frame.semantics, K, rng)
            sparse, target = sparse * factor, target * factor
        return DepthFrame(image, sparse, target, K)


def _with_dense_truth(frame: Frame, sparse: NDArray[np.float32]) -> DepthFrame:
    from completion.types import DepthFrame

    return DepthFrame(frame.image, sparse, frame.target_depth, frame.calibration.K)
