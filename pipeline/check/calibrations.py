"""Checks of one frame's calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError
from pipeline.base.files import read_text
from pipeline.check.faults import Finding
from pipeline.geometry.calibration import Calibration
from pipeline.geometry.key_values import parse_key_values

# KITTI's five recording rigs: image size (height, width) of the day -> focal length and principal point of P_rect_02.
KITTI_RIGS = {
    (375, 1242): (721.5377, 609.5593, 172.8540),  # 2011_09_26
    (370, 1224): (707.0493, 604.0814, 180.5066),  # 2011_09_28
    (374, 1238): (718.3351, 600.3891, 181.5122),  # 2011_09_29
    (370, 1226): (707.0912, 601.8873, 183.1104),  # 2011_09_30
    (376, 1241): (718.8560, 607.1928, 185.2157),  # 2011_10_03
}
# Resizing keeps the aspect ratio, rounded to whole pixels; KITTI's crop of 1216 x 352 changes it by 4 %.
_SAME_ASPECT = 0.012
# Keys that tell the other KITTI calibration files apart from the object benchmark's.
_FAMILIES = {
    "odometry": frozenset({"Tr"}),
    "tracking": frozenset({"R_rect", "Tr_velo_cam"}),
    "raw (calib_cam_to_cam.txt)": frozenset({"P_rect_02", "R_rect_00"}),
    "raw (calib_velo_to_cam.txt)": frozenset({"R", "T"}),
}
_OBJECT_KEYS = ("P2", "R0_rect", "Tr_velo_to_cam")
_WAYMO_KEYS = ("P0", "R0_rect")


def check_family(path: Path, frame: str, camera: int = 2) -> list[Finding]:
    """A file of KITTI's object layout must have the object benchmark's keys."""
    try:
        keys = set(parse_key_values(read_text(path, "a calibration file"), path).lines)
    except DataError as error:
        return [Finding("unreadable_file", frame, str(path), str(error))]
    missing = [key for key in (_OBJECT_KEYS if camera == 2 else _WAYMO_KEYS) if key not in keys]
    if not missing:
        return []
    for name, marks in _FAMILIES.items():
        if marks & keys:
            message = f"this is an {name} file (keys {', '.join(sorted(keys))}); no {', '.join(missing)}"
            return [Finding("wrong_calibration_family", frame, str(path), message.replace("an raw", "a raw"))]
    return [Finding("unreadable_file", frame, str(path), f"no line {', '.join(f'{key}:' for key in missing)}")]


def check_calibration(calibration: Calibration, frame: str, where: str, size: tuple[int, int] | None) -> list[Finding]:
    """Rotations that are none, another KITTI rig's camera matrix, intrinsics of the uncropped image."""
    for name, matrix in (("R0_rect", calibration.R0_rect), ("Tr_velo_to_cam", calibration.T_cam0_velo[:3, :3])):
        residue = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
        if residue > 0.01 or np.linalg.det(matrix) < 0:
            message = f"{name}: R R^T differs from 1 by {residue:.3g}, det {np.linalg.det(matrix):.3f}"
            return [Finding("calibration_not_rigid", frame, where, message)]
    return [] if size is None else _check_rig(calibration, frame, where, size)


def _check_rig(calibration: Calibration, frame: str, where: str, size: tuple[int, int]) -> list[Finding]:
    f, cx, cy = calibration.P2[0, 0], calibration.P2[0, 2], calibration.P2[1, 2]
    own = KITTI_RIGS.get(size)
    if own is not None and abs(f - own[0]) < 0.01 and max(abs(cx - own[1]), abs(cy - own[2])) > 3:
        message = f"principal point {cx:.2f}, {cy:.2f} of a cropped image, expected {own[1]:.2f}, {own[2]:.2f}"
        return [Finding("wrong_crop", frame, where, message)]
    for rig_size, (focal, column, row) in KITTI_RIGS.items():
        if abs(f - focal) > 0.01 or rig_size == size:
            continue
        uncropped = abs(cx - column) < 0.01 and abs(cy - row) < 0.01
        if size in KITTI_RIGS and uncropped:
            own_focal = KITTI_RIGS[size][0]
            message = (
                f"focal length {f:.2f} of the {rig_size[1]} x {rig_size[0]} rig, expected {own_focal:.2f} for this size"
            )
            return [Finding("other_rigs_calibration", frame, where, message)]
        if uncropped and abs(size[1] * rig_size[0] / (size[0] * rig_size[1]) - 1) < _SAME_ASPECT:
            message = f"{size[1]} x {size[0]} pixels with the camera matrix of {rig_size[1]} x {rig_size[0]}"
            return [Finding("resized_image", frame, where, message)]
        if size[0] < rig_size[0] and size[1] <= rig_size[1] and uncropped:
            message = f"cy {cy:.2f} belongs to the uncropped image, expected {cy - (rig_size[0] - size[0]):.2f}"
            return [Finding("wrong_crop", frame, where, message)]
    return []


def calibration_key(calibration: Calibration) -> tuple[float, ...]:
    """Numbers that are equal for frames of one rig, rounded so that text formats do not matter."""
    numbers: NDArray[np.float64] = np.concatenate(
        [calibration.P2[:, :3].ravel() / 1000, calibration.R0_rect.ravel(), calibration.T_cam0_velo[:3].ravel()]
    )
    return tuple(float(value) for value in np.round(numbers, 4))
