"""A scan divided into rings that a method is given and rings that are kept back as truth.

The one definition of both: of the benchmark on real frames (`pipeline.benchmark.held_out_rings`), and of learning from
one's own recordings (`pipeline.training.held_out_rings`). No label and no dense ground truth is needed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.calibration import Calibration
from pipeline.geometry.project import project_points


class RingMaps(NamedTuple):
    """What is given and what is asked, (H, W) float32 depth in metres, 0 = none.

    sparse  all returns of the given rings, as a sensor with so few rings would see them
    truth   visible returns of the other rings, nearest per pixel, none on a pixel of `sparse`
    """

    sparse: NDArray[np.float32]
    truth: NDArray[np.float32]


def ring_maps(
    points: NDArray[np.floating],
    given: NDArray[np.bool_],
    seen: NDArray[np.bool_],
    calibration: Calibration,
    image_size: tuple[int, int],
) -> RingMaps:
    """The maps of points (N, 3+), LiDAR frame, metres.

    given  (N,) of a ring that is given
    seen   (N,) the camera sees it (`visibility.visible_points`); a hidden return stays in `sparse`, where a real
           sensor has it too, and is no truth
    """
    sparse = project_points(points[given], calibration, image_size)
    truth = project_points(points[seen & ~given], calibration, image_size)
    truth[sparse > 0] = 0
    return RingMaps(sparse, truth)
