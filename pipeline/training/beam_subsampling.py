"""Fewer LiDAR rows, drawn anew for every training crop, so that one network completes 64 to 8 rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data import Frame
from pipeline.geometry.project import project_points
from pipeline.geometry.rings import split_rings


@dataclass(frozen=True, eq=False)
class RandomBeamSubsampling:
    """`drawing(rng)` -> a sparse map (H, W) float32 of the frame with every n-th ring, n and the first ring drawn.

    steps      values of n to draw from: (1, 2, 4, 8) gives 64, 32, 16 and 8 rows
    jitter     standard deviation, in degrees, of a rotation between LiDAR and camera; real calibrations are off by it
    """

    frame: Frame
    points: NDArray[np.float32]
    ring: NDArray[np.int64]
    steps: tuple[int, ...]
    jitter: float

    @classmethod
    def of(cls, frame: Frame, steps: tuple[int, ...], jitter: float) -> RandomBeamSubsampling:
        """Splits the frame's cloud once; only points in front of the sensor are kept."""
        ahead = frame.points[:, 0] > 0
        return cls(frame, frame.points[ahead], split_rings(frame.points)[ahead], steps, jitter)

    def __call__(self, rng: np.random.Generator) -> NDArray[np.float32]:
        step = int(rng.choice(self.steps))
        kept = self.points[self.ring % step == rng.integers(step), :3].astype(np.float64)
        angles = np.deg2rad(rng.normal(0, self.jitter, 3)) if self.jitter else np.zeros(3)
        # For angles this small a rotation is one cross product.
        turned = kept + np.cross(angles, kept)
        return project_points(turned, self.frame.calibration, self.frame.image_size)
