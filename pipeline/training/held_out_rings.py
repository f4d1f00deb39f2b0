"""Learning from one's own recordings: some rings of a scan are given, the visible returns of the others are the truth.

Points, calibration and pictures are enough: no labels, no dense ground truth. Every crop draws anew which rings are
given, so that one network completes 32, 16 and 8 rows of a 64-row sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from completion.types import DepthFrame
from pipeline.base.errors import DataError
from pipeline.data import Frame
from pipeline.geometry.held_out import ring_maps
from pipeline.geometry.rings import split_rings
from pipeline.geometry.visibility import visible_points

# Rings that the widest stride must leave: below that nothing lies above or below most pixels.
FEWEST_GIVEN = 4
# Of neighbouring rings in file order, the share whose upper one looks higher. KITTI's 64 rings: all.
IN_ORDER = 0.9


@dataclass(frozen=True, eq=False)
class HeldOutRings:
    """`drawing(rng)` -> the frame with every n-th ring as its sparse map and the other rings as its target.

    points, ring, seen  the frame's returns ahead of the sensor, their rings, and which the camera sees
    steps               values of n to draw from; the first given ring is drawn too
    jitter              standard deviation, degrees, of a rotation between LiDAR and camera, of given and asked alike
    """

    frame: Frame
    points: NDArray[np.float32]
    ring: NDArray[np.int64]
    seen: NDArray[np.bool_]
    steps: tuple[int, ...]
    jitter: float

    @classmethod
    def of(cls, frame: Frame, steps: tuple[int, ...], jitter: float = 0.0) -> HeldOutRings:
        """Splits the frame's cloud once. Raises DataError where it has too few rings, or none that can be told."""
        ring = rings_of(frame, steps)
        seen = visible_points(frame.points, ring, frame.calibration, frame.image_size)
        ahead = frame.points[:, 0] > 0
        return cls(frame, frame.points[ahead], ring[ahead], seen[ahead], steps, jitter)

    def __call__(self, rng: np.random.Generator) -> DepthFrame:
        step = int(rng.choice(self.steps))
        return self.every(step, int(rng.integers(step)), rng.normal(0, 1, 3) * self.jitter)

    def every(self, step: int, first: int = 0, degrees: NDArray[np.floating] | None = None) -> DepthFrame:
        """Rings first, first + step, ... given; `degrees` turn the cloud about x, y and z of the LiDAR frame."""
        points = self.points[:, :3].astype(np.float64)
        if degrees is not None:
            # For angles this small a rotation is one cross product.
            points = points + np.cross(np.deg2rad(degrees), points)
        frame = self.frame
        maps = ring_maps(points, self.ring % step == first, self.seen, frame.calibration, frame.image_size)
        camera = frame.calibration.K
        return DepthFrame(frame.image, maps.sparse, maps.truth, camera)


def rings_of(frame: Frame, steps: tuple[int, ...]) -> NDArray[np.int64]:
    """(N,) ring of each point, 0 = top. Raises DataError unless every n-th of `steps` leaves rings and holds some back.

    Rings are told by the order of the file (`pipeline.geometry.rings`), which must go ring by ring from the top.
    """
    ring = split_rings(frame.points)
    count, needed = int(ring.max(initial=-1)) + 1, FEWEST_GIVEN * max(steps)
    if count < needed:
        raise DataError(
            frame.id,
            f"at least {needed} LiDAR rings, so that every {max(steps)}th leaves {FEWEST_GIVEN}",
            f"{count}; give smaller numbers in train.beam_strides",
        )
    level = np.hypot(frame.points[:, 0], frame.points[:, 1])
    elevation = np.arctan2(frame.points[:, 2], level)
    height = np.array([np.median(elevation[ring == each]) for each in range(count)])
    if (np.diff(height) < 0).mean() < IN_ORDER:
        raise DataError(
            frame.id,
            "points ring after ring from the top, each from the forward direction round (KITTI's order)",
            f"{count} runs of points in another order; sort the cloud by ring and azimuth",
        )
    return ring
