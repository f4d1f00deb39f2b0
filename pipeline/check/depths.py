"""Checks of a depth map against the LiDAR: crop, unit, range instead of depth, another frame's, random weights."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from pipeline.base.errors import DataError
from pipeline.check.faults import Finding
from pipeline.data.depth_fit import LOOSE, TIGHT, UNITS, Depth, Position, agreement, standard_positions
from pipeline.data.images import read_unchanged
from pipeline.geometry.back_project import PixelRays
from pipeline.geometry.calibration import Calibration

FAR_CODE = 65535
# Share of the LiDAR pixels where a map is within 10 %: a working network reaches 0.8 and more, random weights 0.1.
_AGREES, _DISAGREES = 0.7, 0.4
# A shift is named when it fits clearly better than the given position, at the tight tolerance.
_BETTER = 0.10


def read_map(path: Path, frame: str) -> tuple[Depth | None, list[Finding]]:
    """(H, W) float32 metres of a KITTI depth PNG, or None with the reason."""
    try:
        code = read_unchanged(path, "a 16-bit depth PNG")
    except DataError as error:
        return None, [Finding(file_fault(error), frame, str(path), f"expected {error.expected}, got {error.found}")]
    if code.dtype != np.uint16 or code.ndim != 2:
        channels = 1 if code.ndim == 2 else code.shape[2]
        return None, [Finding("eight_bit_depth", frame, str(path), f"{code.dtype} with {channels} channels")]
    if (code == FAR_CODE).mean() > 1e-4:
        share = 100 * float((code == FAR_CODE).mean())
        return None, [Finding("far_plane_as_depth", frame, str(path), f"{share:.1f} % of the pixels are 65535")]
    return code.astype(np.float32) / np.float32(256), []


def file_fault(error: DataError) -> str:
    """The fault behind a reader's complaint about a file."""
    found = error.found
    if "no such file" in found:
        return "missing_file"
    if "empty file" in found:
        return "empty_file"
    if "ends after" in found or "damaged" in found:
        return "truncated_file"
    if "uint8" in found:
        return "eight_bit_depth"
    return "unreadable_file"


def check_depth(
    depth: Depth,
    lidar: Depth,
    calibration: Calibration | None,
    frame: str,
    where: str,
    neighbours: Iterable[tuple[str, Callable[[], Depth | None]]] = (),
) -> list[Finding]:
    """What is wrong with a depth map, judged by the projected LiDAR of the same frame; one cause at most.

    neighbours  (frame, its LiDAR map when asked for): tried when the map fits nowhere in its own frame
    """
    positions = standard_positions((depth.shape[0], depth.shape[1]), (lidar.shape[0], lidar.shape[1]))
    tight = [agreement(depth, lidar, position, TIGHT) for position in positions]
    loose = agreement(depth, lidar, positions[0], LOOSE)
    if depth.shape[0] > lidar.shape[0] or depth.shape[1] > lidar.shape[1]:
        message = f"map of {depth.shape[1]} x {depth.shape[0]}, image of {lidar.shape[1]} x {lidar.shape[0]}"
        return [Finding("wrong_crop", frame, where, message)]
    if tight[0] is None or loose is None:
        return []
    best = int(np.argmax([-1.0 if value is None else value for value in tight]))
    best_value = tight[best] or 0.0
    if best and best_value > tight[0] + _BETTER and best_value > 0.3:
        message = f"fits the LiDAR {positions[best].name} ({100 * best_value:.0f} % of its pixels within 3 %), not "
        return [Finding("wrong_crop", frame, where, message + f"{positions[0].name} ({100 * tight[0]:.0f} %)")]
    if calibration is not None and _is_range(depth, lidar, calibration, positions[0], tight[0]):
        return [Finding("depth_is_range", frame, where, "values are distances to the camera, not z")]
    if loose > _DISAGREES:
        return []
    return [_disagreement(depth, lidar, loose, positions[0], frame, where, neighbours)]


def _is_range(depth: Depth, lidar: Depth, calibration: Calibration, position: Position, given: float) -> bool:
    """True when dividing by the length of the pixel's ray makes the map fit clearly better."""
    rows, columns = (np.arange(size) for size in depth.shape)
    u, v = np.meshgrid(columns + position.left, rows + position.top)
    rays = PixelRays.of(calibration).through(u, v)
    as_range = agreement((depth / np.linalg.norm(rays, axis=-1)).astype(np.float32), lidar, position, TIGHT)
    return as_range is not None and as_range > given + 2 * _BETTER and as_range > 0.5


def _disagreement(
    depth: Depth,
    lidar: Depth,
    loose: float,
    position: Position,
    frame: str,
    where: str,
    neighbours: Iterable[tuple[str, Callable[[], Depth | None]]],
) -> Finding:
    """The cause of a map that does not fit its frame at all."""
    for unit, factor in UNITS.items():
        share = agreement((depth * np.float32(factor)).astype(np.float32), lidar, position, LOOSE)
        if share is not None and share > _AGREES:
            return Finding("depth_unit", frame, where, f"read as {unit} the map fits {100 * share:.0f} % of the LiDAR")
    for other, load in neighbours:
        reference = load()
        share = None if reference is None else agreement(depth, reference, position, LOOSE)
        if share is not None and share > _AGREES:
            return Finding(
                "index_offset", frame, where, f"the map fits frame {other} ({100 * share:.0f} % of its LiDAR)"
            )
    message = f"only {100 * loose:.0f} % of the LiDAR pixels are within 10 % of the map"
    return Finding("depth_disagrees_with_lidar", frame, where, message)
