"""Semi-dense pseudo ground truth in the style of Uhrig et al. 2017 ("Sparsity Invariant CNNs", section 4).

Eleven scans are accumulated with slightly wrong poses, moving things are left where each scan saw them, and what
disagrees with semi-global stereo matching is thrown away. The errors that survive are the ones the thesis studies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.calibration import Calibration
from pipeline.geometry.project import project_points
from pipeline.simulation.rig import BASELINE

HALF_WINDOW = 5
# Largest relative difference from stereo. Rendered pairs match better than photographs: with 3 % and more the map would
# be denser than KITTI's.
RENDERED_TOLERANCE = 0.015


@dataclass(frozen=True)
class PoseNoise:
    """Error of each scan's pose: rotation in degrees and translation in metres, standard deviation per axis."""

    rotation: float = 0.05
    translation: float = 0.01


def accumulate(
    scans: Sequence[NDArray[np.float32]], T_world_velo: Sequence[NDArray[np.float64]], centre: int,
    noise: PoseNoise, rng: np.random.Generator,
) -> NDArray[np.float64]:  # fmt: skip
    """(M, 3) points of all scans in the LiDAR frame of scan `centre`, each but that one with its pose error."""
    to_centre = np.linalg.inv(T_world_velo[centre])
    parts = []
    for index, (points, pose) in enumerate(zip(scans, T_world_velo, strict=True)):
        T_centre_scan = to_centre @ pose
        if index != centre:
            T_centre_scan = T_centre_scan @ _pose_error(noise, rng)
        parts.append(points[:, :3].astype(np.float64) @ T_centre_scan[:3, :3].T + T_centre_scan[:3, 3])
    return np.concatenate(parts)


def _pose_error(noise: PoseNoise, rng: np.random.Generator) -> NDArray[np.float64]:
    """(4, 4) small rotation and translation."""
    x, y, z = np.radians(rng.normal(0, noise.rotation, 3))
    error = np.eye(4)
    left, _, right = np.linalg.svd(np.array([[1, -z, y], [z, 1, -x], [-y, x, 1]]))
    error[:3, :3] = left @ right
    error[:3, 3] = rng.normal(0, noise.translation, 3)
    return error


def stereo_depth(left: NDArray[np.uint8], right: NDArray[np.uint8], focal: float) -> NDArray[np.float32]:
    """(H, W) float32 metres of the left view by semi-global matching of two (H, W, 3) images; 0 = no match.

    OpenCV's three-way SGBM, 5 x 5 blocks, left-right check of one pixel; disparities up to 192 px (at full size).
    """
    import cv2

    count = int(np.clip(16 * np.ceil(192 * focal / 721.5377 / 16), 16, 192))
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=count, blockSize=5, P1=8 * 3 * 25, P2=32 * 3 * 25, disp12MaxDiff=1,
        uniquenessRatio=15, speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    # The matcher leaves the first `count` columns empty: they are padded and cut again.
    padded = [cv2.copyMakeBorder(image, 0, 0, count, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    disparity = matcher.compute(*padded)[:, count:].astype(np.float32) / 16
    depth = np.zeros_like(disparity)
    valid = disparity > 0.5
    depth[valid] = focal * BASELINE / disparity[valid]
    return depth


def consistent(
    accumulated: NDArray[np.float32], current: NDArray[np.float32], stereo: NDArray[np.float32],
    tolerance: float = 0.03, max_depth: float = 80.0,
) -> NDArray[np.float32]:  # fmt: skip
    """The accumulated map where it agrees with stereo; all maps (H, W) metres, 0 = none.

    tolerance  largest |z - z_stereo| / z_stereo; where stereo has no match only pixels of the current scan stay
    """
    agrees = (stereo > 0) & (np.abs(accumulated - stereo) < tolerance * stereo)
    unmatched = (stereo == 0) & (current > 0)
    kept = np.where(agrees, accumulated, np.where(unmatched, current, 0))
    return np.where(kept <= max_depth, kept, 0).astype(np.float32)


def semi_dense(
    scans: Sequence[NDArray[np.float32]], T_world_velo: Sequence[NDArray[np.float64]], centre: int,
    stereo: NDArray[np.float32], calibration: Calibration, rng: np.random.Generator, noise: PoseNoise | None = None,
) -> NDArray[np.float32]:  # fmt: skip
    """(H, W) float32 pseudo ground truth in metres for scan `centre` of a window of scans (N, 4) with their poses.

    stereo  (H, W) metres, see `stereo_depth`
    """
    size = (stereo.shape[0], stereo.shape[1])
    cloud = accumulate(scans, T_world_velo, centre, noise or PoseNoise(), rng)
    accumulated = project_points(cloud, calibration, size)
    return consistent(accumulated, project_points(scans[centre], calibration, size), stereo, RENDERED_TOLERANCE)
