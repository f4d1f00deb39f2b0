"""KITTI's cameras and LiDAR mount, varied a little from frame to frame.

Intrinsics are those of the five recording days (calib_cam_to_cam.txt, P_rect_02; image sizes of the object set); the
extrinsics are those of 2011_09_26.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.calibration import Calibration

BASELINE = 0.532725
LIDAR_HEIGHT = 1.73

# (height, width), focal length, principal point, fourth column of P2; with the share of frames of each.
_DAYS: tuple[tuple[tuple[int, int], float, tuple[float, float], tuple[float, float, float], float], ...] = (
    ((375, 1242), 721.5377, (609.5593, 172.8540), (44.85728, 0.2163791, 0.002745884), 0.70),
    ((370, 1224), 707.0493, (604.0814, 180.5066), (45.75831, -0.3454157, 0.004981016), 0.12),
    ((374, 1238), 718.3351, (600.3891, 181.5122), (44.50382, -0.5951107, 0.002616315), 0.06),
    ((370, 1226), 707.0912, (601.8873, 183.1104), (46.88783, 0.1178601, 0.006203223), 0.06),
    ((376, 1241), 718.8560, (607.1928, 185.2157), (45.38225, -0.1130887, 0.003779761), 0.06),
)

_R0_RECT = np.array(
    [
        [0.9999239, 0.00983776, -0.007445048],
        [-0.009869795, 0.9999421, -0.004278459],
        [0.007402527, 0.004351614, 0.9999631],
    ]
)
_T_CAM0_VELO = np.array(
    [
        [0.007533745, -0.9999714, -0.000616602, -0.004069766],
        [0.01480249, 0.0007280733, -0.9998902, -0.07631618],
        [0.9998621, 0.00752379, 0.01480755, -0.2717806],
        [0, 0, 0, 1],
    ]
)


def _rotation(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) rotation by small angles (radians) about x, y, z."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


def draw_rig(rng: np.random.Generator, size: tuple[int, int] | None) -> tuple[Calibration, tuple[int, int]]:
    """A calibration and its (height, width).

    size  None draws one of KITTI's five cameras; else 2011_09_26's camera with its field of view scaled to that size
    The extrinsics vary by about 0.1 degrees and 1 cm.
    """
    day = _DAYS[int(rng.choice(len(_DAYS), p=[d[-1] for d in _DAYS]))] if size is None else _DAYS[0]
    (height, width), focal, (cx, cy), column, _ = day
    scale = 1.0 if size is None else size[1] / width
    focal = focal * scale * float(1 + rng.normal(0, 0.002))
    centre_y = cy if size is None else (cy + 0.5) * size[0] / height - 0.5
    centre_x = (cx + 0.5) * scale - 0.5
    P2 = np.array(
        [[focal, 0, centre_x, column[0] * scale], [0, focal, centre_y, column[1] * scale], [0, 0, 1, column[2]]]
    )
    P3 = P2.copy()
    P3[0, 3] -= focal * BASELINE
    T_cam0_velo = _T_CAM0_VELO.copy()
    # The published rotation has seven digits: orthonormal again, then turned a little.
    left, _, right = np.linalg.svd(T_cam0_velo[:3, :3])
    T_cam0_velo[:3, :3] = _rotation(rng.normal(0, 0.0015, 3)) @ left @ right
    T_cam0_velo[:3, 3] += rng.normal(0, 0.01, 3)
    left, _, right = np.linalg.svd(_R0_RECT)
    calibration = Calibration(P2=P2, R0_rect=left @ right, T_cam0_velo=T_cam0_velo, P3=P3)
    return calibration, (height, width) if size is None else size
