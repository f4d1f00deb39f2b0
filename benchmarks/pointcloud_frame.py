"""One full-size frame for the point-cloud benchmarks: a street of planes and boxes, ray-cast in closed form.

1242 x 375 depth without holes, about 18,000 returns of a 64-row scanner, and a completed depth with smeared edges whose
sigma and surfaces follow from the local spread, as a twin-surface network gives them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from completion.types import CompletedDepth
from pipeline.geometry.back_project import back_project
from pipeline.geometry.calibration import Calibration
from pipeline.pointcloud.range_image import RangeGrid, range_sample

HEIGHT, WIDTH = 375, 1242


@dataclass(frozen=True)
class StreetFrame:
    """Completed depth, true depth (H, W) in metres, and raw points (N, 4) in the LiDAR frame."""

    completed: CompletedDepth
    truth: NDArray[np.float32]
    points: NDArray[np.float32]
    calibration: Calibration


def kitti_calibration() -> Calibration:
    """A camera and a LiDAR as they stand on KITTI's car (rounded)."""
    P2 = np.array([[721.5, 0, 609.6, 44.86], [0, 721.5, 172.9, 0.216], [0, 0, 1, 0.0027]])
    T = np.array([[0.0, -1, 0, -0.004], [0, 0, -1, -0.076], [1, 0, 0, -0.272], [0, 0, 0, 1]])
    return Calibration(P2=P2, R0_rect=np.eye(3), T_cam0_velo=T)


def _true_depth(rng: np.random.Generator, calibration: Calibration) -> NDArray[np.float32]:
    """Depth of a road, two rows of houses, and boxes the size of cars, posts and hedges."""
    P2 = calibration.P2
    slope_u = (np.arange(WIDTH) - P2[0, 2]) / P2[0, 0]
    slope_v = (np.arange(HEIGHT) - P2[1, 2])[:, None] / P2[1, 1]
    with np.errstate(divide="ignore"):
        depth = np.where(slope_v > 0, 1.65 / slope_v, np.inf) + 0 * slope_u
        walls = 7.5 / np.abs(slope_u) * (1 + 0.02 * np.sin(np.arange(WIDTH) / 9))
    depth = np.minimum(depth, np.minimum(walls, 78.0))
    kinds = ((1.8, 1.5, 4.2), (0.3, 3.0, 0.3), (2.5, 1.2, 1.5))
    for number in range(45):
        width, height, length = kinds[number % 3]
        x, near = rng.uniform(-9, 9), rng.uniform(6, 65)
        lo, hi = np.array([x - width / 2, 1.65 - height, near]), np.array([x + width / 2, 1.65, near + length])
        enter = np.full((HEIGHT, WIDTH), lo[2])
        leave = np.full((HEIGHT, WIDTH), hi[2])
        for slope, a, b in ((slope_u + 0 * slope_v, lo[0], hi[0]), (slope_v + 0 * slope_u, lo[1], hi[1])):
            with np.errstate(divide="ignore", invalid="ignore"):
                first, second = a / slope, b / slope
            enter = np.fmax(enter, np.fmin(first, second))
            leave = np.fmin(leave, np.fmax(first, second))
        depth = np.where(enter <= leave, np.minimum(depth, enter), depth)
    return depth.astype(np.float32)


def street_frame(seed: int = 0) -> StreetFrame:
    """The frame; the same for the same seed."""
    rng = np.random.default_rng(seed)
    calibration = kitti_calibration()
    truth = _true_depth(rng, calibration)
    dense = back_project(truth, calibration, np.ones_like(truth, dtype=bool))
    seen = range_sample(dense.points, RangeGrid(rows=64, az_steps=520))
    points = np.zeros((len(seen), 4), np.float32)
    points[:, :3] = dense.points[seen] + rng.normal(0, 0.01, (len(seen), 3))
    # Errors of a network are smooth over some pixels and grow with distance; here about 1 %.
    error = cv2.GaussianBlur(rng.normal(0, 0.15, truth.shape).astype(np.float32), (0, 0), 4.0)
    smeared = cv2.GaussianBlur(truth, (0, 0), 1.2) * (1 + error)
    near, far = cv2.erode(truth, np.ones((5, 5))), cv2.dilate(truth, np.ones((5, 5)))
    smeared = np.clip(smeared, near, far)
    sigma = np.where(far > near, (far - smeared) / np.maximum(far - near, 1e-6), 1)
    completed = CompletedDepth(smeared, near, far, sigma.astype(np.float32).clip(0, 1))
    return StreetFrame(completed, truth, points, calibration)
