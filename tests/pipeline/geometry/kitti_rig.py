"""KITTI's published calibration of 26 September 2011 (most of the object benchmark), so that tests always have it."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.calibration import Calibration, parse_calibration

TEXT = """
P2: 7.215377e+02 0 6.095593e+02 4.485728e+01 0 7.215377e+02 1.728540e+02 2.163791e-01 0 0 1 2.745884e-03
R0_rect: 9.999239e-01 9.837760e-03 -7.445048e-03 -9.869795e-03 9.999421e-01 -4.278459e-03 7.402527e-03 4.351614e-03 9.999631e-01
Tr_velo_to_cam: 7.533745e-03 -9.999714e-01 -6.166020e-04 -4.069766e-03 1.480249e-02 7.280733e-04 -9.998902e-01 -7.631618e-02 9.998621e-01 7.523790e-03 1.480755e-02 -2.717806e-01
"""  # noqa: E501
RIG = parse_calibration(TEXT, "KITTI 2011_09_26")
SIZE = (375, 1242)

# LiDAR axes turned into camera axes at the same place.
TURN = np.array([[0, -1.0, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def camera(*rows: list[float]) -> Calibration:
    """A camera with this P2 at the LiDAR's place."""
    return Calibration(P2=np.array(rows), R0_rect=np.eye(3), T_cam0_velo=TURN)
