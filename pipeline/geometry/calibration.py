"""Calibration of a camera and a LiDAR, read by key name from the KITTI families of files.

Frames: `velo` (x forward, y left, z up), `cam` = rectified camera 0 (x right, y down, z forward), image 2 in pixels.
Transforms are `T_target_source`, so T_cam_velo @ p_velo reads. Sources: KITTI devkit readme; Geiger et al. 2013.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError
from pipeline.base.files import read_text
from pipeline.geometry.key_values import parse_key_values

Array = NDArray[np.float64]

# The same matrix under the names that the object, tracking and odometry benchmarks give it.
_RECTIFICATION_KEYS = ("R0_rect", "R_rect", "R_rect_00")
_VELO_KEYS = ("Tr_velo_to_cam", "Tr_velo_cam", "Tr")


# Far beyond any camera: a focal length of 1e6 pixels, a sensor 1e6 m away.
_MAX_ENTRY, _MAX_CONDITION = 1e6, 1e9


@dataclass(frozen=True)
class Calibration:
    """One camera and one LiDAR.

    P2          (3, 4) rectified camera 0 -> pixels of the colour image
    R0_rect     (3, 3) camera 0 -> rectified camera 0
    T_cam0_velo (4, 4) LiDAR -> unrectified camera 0 (KITTI's Tr_velo_to_cam)
    P3          (3, 4) the right colour camera, or None
    """

    P2: Array
    R0_rect: Array
    T_cam0_velo: Array
    P3: Array | None = None

    def __post_init__(self) -> None:
        shapes = {"P2": (3, 4), "R0_rect": (3, 3), "T_cam0_velo": (4, 4)}
        if self.P3 is not None:
            shapes["P3"] = (3, 4)
        for name, shape in shapes.items():
            matrix = np.asarray(getattr(self, name), dtype=np.float64)
            if matrix.shape != shape or not np.isfinite(matrix).all():
                raise DataError(f"calibration {name}", f"a finite {shape} matrix", f"shape {matrix.shape}")
            object.__setattr__(self, name, matrix)
        if self.P2[0, 0] <= 0 or self.P2[1, 1] <= 0:
            raise DataError("calibration P2", "positive focal lengths", f"{self.P2[0, 0]:g}, {self.P2[1, 1]:g}")
        rotations = {"P2": self.K, "R0_rect": self.R0_rect, "T_cam0_velo": self.T_cam0_velo}
        for name, matrix in rotations.items():
            if np.abs(matrix).max() > _MAX_ENTRY or np.linalg.cond(matrix) > _MAX_CONDITION:
                expected = "a camera matrix" if name == "P2" else "a rotation"
                raise DataError(f"calibration {name}", expected, "numbers that cannot be inverted")

    @cached_property
    def T_cam_velo(self) -> Array:
        """(4, 4) LiDAR -> rectified camera 0: R0_rect * Tr_velo_to_cam."""
        rectify = np.eye(4)
        rectify[:3, :3] = self.R0_rect
        return rectify @ self.T_cam0_velo

    @cached_property
    def T_velo_cam(self) -> Array:
        """(4, 4) rectified camera 0 -> LiDAR."""
        return np.asarray(np.linalg.inv(self.T_cam_velo), dtype=np.float64)

    @property
    def K(self) -> Array:
        """(3, 3) camera matrix of P2."""
        return self.P2[:, :3]

    def cropped(self, top: int, left: int) -> Calibration:
        """The calibration of an image whose first `top` rows and `left` columns are cut away."""
        shift = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]])
        return replace(self, P2=shift @ self.P2, P3=None if self.P3 is None else shift @ self.P3)

    def velo_to_cam(self, points: NDArray[np.floating]) -> Array:
        """(N, 3+) LiDAR points -> (N, 3) rectified camera points, metres."""
        return np.asarray(points[:, :3], dtype=np.float64) @ self.T_cam_velo[:3, :3].T + self.T_cam_velo[:3, 3]

    def cam_to_velo(self, points: NDArray[np.floating]) -> Array:
        """(N, 3) rectified camera points -> (N, 3) LiDAR points, metres."""
        return np.asarray(points[:, :3], dtype=np.float64) @ self.T_velo_cam[:3, :3].T + self.T_velo_cam[:3, 3]

    def cam_to_image(self, points: Array) -> tuple[Array, Array]:
        """(N, 3) rectified camera points -> ((N, 2) u v in pixels, (N,) depth z in metres of camera 0)."""
        homogeneous = points @ self.P2[:, :3].T + self.P2[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            return homogeneous[:, :2] / homogeneous[:, 2:3], points[:, 2]


def parse_calibration(text: str, where: str | Path = "calibration", camera: int = 2) -> Calibration:
    """An object, tracking or odometry calibration file (one file with P2, R0_rect and Tr_velo_to_cam).

    camera  whose images are used: 2 in KITTI; 0 for the front camera of Waymo's KITTI form (P0, Tr_velo_to_cam_0)
    Odometry files have no rectification line: their `Tr` maps to the rectified camera, so R0_rect is the identity.
    Raises DataError when a needed key is missing: nothing is guessed.
    """
    values = parse_key_values(text, where)
    P2 = values.matrix((f"P{camera}",), (3, 4))
    odometry = "Tr" in values and not any(key in values for key in _RECTIFICATION_KEYS)
    R0_rect = np.eye(3) if odometry else values.matrix(_RECTIFICATION_KEYS, (3, 3))
    names = (*_VELO_KEYS, f"{_VELO_KEYS[0]}_{camera}") if camera != 2 else _VELO_KEYS
    T_cam0_velo = np.vstack([values.matrix(names, (3, 4)), [0, 0, 0, 1]])
    P3 = values.matrix(("P3",), (3, 4)) if "P3" in values and camera == 2 else None
    return _calibration(P2, R0_rect, T_cam0_velo, P3, where)


def parse_raw_calibration(cam_to_cam: str, velo_to_cam: str, where: str | Path = "calibration") -> Calibration:
    """The two files of a raw drive: calib_cam_to_cam.txt (P_rect_02, R_rect_00), calib_velo_to_cam.txt (R, T)."""
    cameras, velodyne = parse_key_values(cam_to_cam, where), parse_key_values(velo_to_cam, where)
    T_cam0_velo = np.eye(4)
    T_cam0_velo[:3, :3] = velodyne.matrix(("R",), (3, 3))
    T_cam0_velo[:3, 3] = velodyne.matrix(("T",), (3, 1))[:, 0]
    P3 = cameras.matrix(("P_rect_03",), (3, 4)) if "P_rect_03" in cameras else None
    P2, R0_rect = cameras.matrix(("P_rect_02",), (3, 4)), cameras.matrix(("R_rect_00",), (3, 3))
    return _calibration(P2, R0_rect, T_cam0_velo, P3, where)


def _calibration(P2: Array, R0_rect: Array, T_cam0_velo: Array, P3: Array | None, where: str | Path) -> Calibration:
    """A Calibration whose trouble names the file it was read from."""
    try:
        return Calibration(P2=P2, R0_rect=R0_rect, T_cam0_velo=T_cam0_velo, P3=P3)
    except DataError as error:
        name = error.where.removeprefix("calibration ").replace("T_cam0_velo", "Tr_velo_to_cam")
        raise DataError(where, f"{error.expected} under {name}", error.found) from None


def read_calibration(path: str | Path, camera: int = 2) -> Calibration:
    """A calibration file on disk; see `parse_calibration`."""
    path = Path(path)
    return parse_calibration(read_text(path, "a calibration file"), path, camera)


def format_calibration(calibration: Calibration) -> str:
    """The text of a KITTI object calibration file (P0-P3, R0_rect, Tr_velo_to_cam, Tr_imu_to_velo)."""
    P3 = calibration.P2 if calibration.P3 is None else calibration.P3
    grey = np.column_stack([calibration.P2[:, :3], np.zeros(3)])
    rows = {
        "P0": grey,
        "P1": grey,
        "P2": calibration.P2,
        "P3": P3,
        "R0_rect": calibration.R0_rect,
        "Tr_velo_to_cam": calibration.T_cam0_velo[:3],
        "Tr_imu_to_velo": np.eye(4)[:3],
    }
    return "".join(f"{key}: " + " ".join(f"{v:.12e}" for v in np.ravel(m)) + "\n" for key, m in rows.items()) + "\n"
