"""Other projects' answers to "is this LiDAR point in the image?", each under the project's name.

For exports that must equal what these projects make themselves; our own answer is `pipeline.geometry.in_view`.
OpenPCDet's rule has one home in `detection.inputs`, whose networks were trained behind it; SFD, VirConv and TED are
built on OpenPCDet and keep it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detection.inputs import openpcdet_field_of_view
from pipeline.geometry.calibration import Calibration

# mmdetection3d's frustum, metres in front of camera 2.
NEAR, FAR = 0.001, 100.0


def in_view_openpcdet(
    points: NDArray[np.floating], calibration: Calibration, image_size: tuple[int, int]
) -> NDArray[np.bool_]:
    """(N,) True for LiDAR points (N, 3+) that OpenPCDet's `get_fov_flag` keeps in a (height, width) image.

    0 <= u < width and 0 <= v < height without rounding, divided by z of camera 0, and z >= 0.
    """
    return openpcdet_field_of_view(calibration.velo_to_cam(points), calibration.P2, image_size)


def in_view_mmdet3d(
    points: NDArray[np.floating], calibration: Calibration, image_size: tuple[int, int]
) -> NDArray[np.bool_]:
    """(N,) True for LiDAR points (N, 3+) that mmdetection3d's `remove_outside_points` keeps in a (height, width) image.

    Strictly inside the frustum of camera 2: 0 < u < width and 0 < v < height, divided by the third coordinate of P2,
    and 0.001 m < depth < 100 m from camera 2.
    """
    P2 = calibration.P2
    camera = calibration.velo_to_cam(points)
    pixels, _ = calibration.cam_to_image(camera)
    depth = (camera @ P2[2, :3] + P2[2, 3]) / P2[2, 2]
    height, width = image_size
    inside = (pixels > 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    return np.asarray(inside & (depth > NEAR) & (depth < FAR))
