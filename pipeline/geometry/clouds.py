"""The cloud of completed points on its way through the steps, each point still knowing its pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class DenseCloud:
    """Completed points and where they come from.

    points  (N, 3) float32 x y z in metres, LiDAR frame
    pixels  (N,) int32, row * width + column of each point in the maps of its frame
    """

    points: NDArray[np.float32]
    pixels: NDArray[np.int32]

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3 or len(self.points) != len(self.pixels):
            raise ValueError(f"dense cloud: {self.points.shape} points and {self.pixels.shape} pixels do not fit")

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def empty(cls) -> DenseCloud:
        """No points."""
        return cls(np.zeros((0, 3), np.float32), np.zeros(0, np.int32))

    def select(self, keep: NDArray[Any]) -> DenseCloud:
        """The points of a boolean mask or an index list, in that order."""
        return DenseCloud(self.points[keep], self.pixels[keep])

    def look_up(self, values: NDArray[Any]) -> NDArray[Any]:
        """(N,) values of an (H, W) map at the points' pixels."""
        return values.reshape(-1)[self.pixels]
