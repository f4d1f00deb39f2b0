"""Which points of a cloud a network sees. Every sampler is seeded, returns shuffled indices, and takes any cloud size.

Networks number their groups by index order, so the order must be random and never sorted.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]


def near_far_sample(points: NDArray[Any], count: int, rng: np.random.Generator, far: float = 40.0) -> Index:
    """(count,) indices by PointRCNN's rule: all points with z >= `far` metres, nearer ones drawn at random.

    points  (N, 3+) rectified camera frame, N >= 1
    With fewer points than `count`, all of them and duplicates (without replacement while N >= count / 2, else with).
    With more far points than `count`, a uniform draw over all points. Raises ValueError for an empty cloud.
    """
    if len(points) <= count:
        return _repeat(len(points), count, rng)
    is_far = points[:, 2] >= far
    far_index, near_index = np.flatnonzero(is_far), np.flatnonzero(~is_far)
    if len(far_index) > count:
        return uniform_sample(points, count, rng)
    near_index = rng.choice(near_index, count - len(far_index), replace=False)
    return rng.permutation(np.concatenate([far_index, near_index]))


def uniform_sample(points: NDArray[Any], count: int, rng: np.random.Generator) -> Index:
    """(count,) indices drawn without replacement (thesis section 5.2: 50k of a dense cloud); duplicates if too few."""
    if len(points) <= count:
        return _repeat(len(points), count, rng)
    return rng.choice(len(points), count, replace=False)


def balanced_sample(points: NDArray[Any], height: NDArray[Any], count: int, rng: np.random.Generator) -> Index:
    """(count,) indices drawn without replacement, rarer where points are plenty or seldom on an object.

    points  (N, 3+) camera frame        height  (N,) metres above the local ground
    Weight: horizontal range / 30 m in [0.2, 1.5], times 0.3 for points lower than 0.2 m or higher than 2.5 m.
    Weighted sampling by the exponential keys of Efraimidis and Spirakis (2006); duplicates if there are too few points.
    """
    if len(points) <= count:
        return _repeat(len(points), count, rng)
    distance = np.hypot(points[:, 0], points[:, 2])
    weight = np.clip(distance / 30.0, 0.2, 1.5) * np.where((height < 0.2) | (height > 2.5), 0.3, 1.0)
    keys = rng.standard_exponential(len(points)) / weight
    return rng.permutation(np.argpartition(keys, count - 1)[:count])


def _repeat(available: int, count: int, rng: np.random.Generator) -> Index:
    """All indices below `available` and as many duplicates as reach `count`, shuffled."""
    if available == 0:
        raise ValueError(
            "cannot sample from an empty cloud: no point lies in the camera's view and the detection range"
        )
    missing = count - available
    extra = rng.choice(available, missing, replace=missing > available)
    return rng.permutation(np.concatenate([np.arange(available), extra]))
