"""Semi-dense pseudo truth of a single frame (Table 5.1): the errors of accumulated LiDAR, put on exact depth.

Real pseudo truth (`pipeline.simulation.semi_dense`) needs eleven scans and a stereo pair of a drive. For frames that
stand alone the same steps are modelled: eleven scans are drawn from the true depth, each with its pose error; what
moves has been elsewhere in the other ten; stereo is the true disparity with matching noise and holes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import UsageError
from pipeline.base.seeds import derive_seed
from pipeline.data import Frame
from pipeline.geometry.back_project import back_project
from pipeline.geometry.project import project_points
from pipeline.pointcloud.range_image import RangeGrid, range_sample
from pipeline.pointcloud.semantic_mask import OBJECTS, object_score
from pipeline.simulation.rig import BASELINE
from pipeline.simulation.semi_dense import HALF_WINDOW, PoseNoise, accumulate, consistent

PERIOD = 0.1  # seconds between scans
MOVING_SHARE, SPEED = 0.4, (2.0, 12.0)  # of the objects; metres a second along the street
DISPARITY_NOISE, UNMATCHED = 0.35, 0.35  # pixels; share of pixels without a stereo match


def semi_dense_of(frame: Frame) -> NDArray[np.float32]:
    """(H, W) float32 metres, 0 = none. UsageError for a frame without dense truth, classes and instances."""
    if not all(frame.has(part) for part in ("target_depth", "semantics", "instances")):
        raise UsageError(f"{frame.where} frame {frame.id}: semi-dense pseudo truth needs true depth and instances")
    rng = np.random.default_rng(derive_seed(0, frame.id, "semi_dense"))
    truth, camera = frame.target_depth, frame.calibration
    cloud = back_project(truth, camera, truth > 0)
    speed = _speeds(frame, rng)[cloud.pixels]
    scans = []
    for offset in range(-HALF_WINDOW, HALF_WINDOW + 1):
        grid = RangeGrid(64, 512, top=2.0 + float(rng.uniform(0, 0.4)), horizontal=90.0 + float(rng.uniform(0, 0.2)))
        chosen = range_sample(cloud.points, grid)
        points = cloud.points[chosen].copy()
        points[:, 0] += speed[chosen] * np.float32(PERIOD * offset)
        scans.append(np.column_stack([points, np.zeros(len(points))]).astype(np.float32))
    poses = [np.eye(4)] * len(scans)
    accumulated = project_points(accumulate(scans, poses, HALF_WINDOW, PoseNoise(), rng), camera, frame.image_size)
    current = project_points(scans[HALF_WINDOW], camera, frame.image_size)
    return consistent(accumulated, current, _stereo(truth, float(camera.K[0, 0]), rng))


def _speeds(frame: Frame, rng: np.random.Generator) -> NDArray[np.float32]:
    """(H * W,) metres a second along x of each pixel's object, 0 for what stands."""
    instances = np.where(object_score(frame.semantics, OBJECTS) > 0, frame.instances, 0)
    count = int(instances.max()) + 1
    speeds = rng.uniform(*SPEED, count) * rng.choice([-1, 1], count) * (rng.random(count) < MOVING_SHARE)
    speeds[0] = 0
    return speeds[instances].reshape(-1).astype(np.float32)


def _stereo(truth: NDArray[np.float32], focal: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """(H, W) metres as semi-global matching would give them; 0 = no match."""
    valid = (truth > 0) & (rng.random(truth.shape) >= UNMATCHED)
    disparity = focal * BASELINE / np.where(truth > 0, truth, 1) + rng.normal(0, DISPARITY_NOISE, truth.shape)
    return np.where(valid & (disparity > 0.5), focal * BASELINE / np.maximum(disparity, 0.5), 0).astype(np.float32)
