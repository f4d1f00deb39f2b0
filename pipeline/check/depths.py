"""Checks of a depth map against the LiDAR: crop, unit, range instead of depth, another frame's, random weights."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError
from pipeline.check.faults import Finding
from pipeline.data.images import read_unchanged
from pipeline.geometry.back_project import PixelRays
from pipeline.geometry.calibration import Calibration

FAR_CODE = 65535
# Share of the LiDAR pixels where a map is within 10 %: a working network reaches 0.8 and more, random weights 0.1.
_AGREES, _DISAGREES = 0.7, 0.4
_LOOSE, _TIGHT = 0.10, 0.03
# A shift is named when it fits clearly better than the given position, at the tight tolerance.
_BETTER = 0.10
_FEWEST = 50
_UNITS = {"millimetres": 256 / 1000, "centimetres": 256 / 100, "metres": 256.0, "millimetres x 256": 1 / 1000}
Depth = NDArray[np.float32]


@dataclass(frozen=True)
class Position:
    """Where a map's first pixel lies in the full image (row, column), and how one calls it."""

    top: int
    left: int
    name: str


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


def standard_positions(size: tuple[int, int], image: tuple[int, int]) -> list[Position]:
    """Where a map of `size` may lie in an image of size `image` (height, width), the right one first.

    Equal sizes: in place. Smaller: bottom-centre is KITTI's crop; top-left, centre and bottom-left are the known slips.
    """
    bottom, middle = image[0] - size[0], round((image[1] - size[1]) / 2)
    found = [Position(bottom, middle, "bottom-centre")]
    if size == image:
        found = [Position(0, 0, "in place")]
        crops = ((image[0] - 352, round((image[1] - 1216) / 2)), ((image[0] - 352) // 2, round((image[1] - 1216) / 2)))
        for top, left in crops:
            if top > 0 or left > 0:
                # A crop pasted at the corner of the full image, and the reverse.
                found += [Position(s * top, s * left, f"shifted by {s * top}, {s * left} px") for s in (1, -1)]
                found += [Position(s * top, 0, f"shifted by {s * top} rows") for s in (1, -1) if left]
        return found
    slips = ((0, 0, "top-left"), (bottom // 2, middle, "centre"), (bottom, 0, "bottom-left"), (0, middle, "top-centre"))
    return found + [Position(*slip) for slip in slips if slip[:2] != (bottom, middle)]


def agreement(depth: Depth, lidar: Depth, position: Position, tolerance: float) -> float | None:
    """Share of the LiDAR pixels under the map where it lies within `tolerance`; None with too few of them.

    depth (h, w) and lidar (H, W) in metres, 0 = none; `position` is the map's place in the LiDAR image.
    """
    v, u = np.nonzero(lidar)
    row, column = v - position.top, u - position.left
    inside = (row >= 0) & (row < depth.shape[0]) & (column >= 0) & (column < depth.shape[1])
    value = depth[row[inside], column[inside]]
    reference = lidar[v[inside], u[inside]]
    known = value > 0
    if known.sum() < _FEWEST:
        return None
    return float((np.abs(value[known] / reference[known] - 1) < tolerance).mean())


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
    tight = [agreement(depth, lidar, position, _TIGHT) for position in positions]
    loose = agreement(depth, lidar, positions[0], _LOOSE)
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
    as_range = agreement((depth / np.linalg.norm(rays, axis=-1)).astype(np.float32), lidar, position, _TIGHT)
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
    for unit, factor in _UNITS.items():
        share = agreement((depth * np.float32(factor)).astype(np.float32), lidar, position, _LOOSE)
        if share is not None and share > _AGREES:
            return Finding("depth_unit", frame, where, f"read as {unit} the map fits {100 * share:.0f} % of the LiDAR")
    for other, load in neighbours:
        reference = load()
        share = None if reference is None else agreement(depth, reference, position, _LOOSE)
        if share is not None and share > _AGREES:
            return Finding(
                "index_offset", frame, where, f"the map fits frame {other} ({100 * share:.0f} % of its LiDAR)"
            )
    message = f"only {100 * loose:.0f} % of the LiDAR pixels are within 10 % of the map"
    return Finding("depth_disagrees_with_lidar", frame, where, message)
