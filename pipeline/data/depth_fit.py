"""Whether a depth map from elsewhere fits the LiDAR of its frame, and if not, which slip explains it.

A map in millimetres, of half size or of another crop has values everywhere and ruins the cloud without a word. The
LiDAR tells: a working network agrees with it at 80 % of its pixels within 10 %, one with random weights at 10 %.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError

LOOSE, TIGHT = 0.10, 0.03
# What a value times 256 may have meant instead of metres: factors on what was read.
UNITS = {"millimetres": 256 / 1000, "centimetres": 256 / 100, "metres": 256.0, "millimetres x 256": 1 / 1000}
# Share of the LiDAR pixels that must agree: with another explanation to name it, and for a map to be taken at all.
_FITS, _LEAST = 0.7, 0.2
_FEWEST = 50
# At this share a map is taken and nothing else is tried; below, an explanation must fit so much better.
_GOOD, _BETTER = 0.75, 0.15
# Rows by which maps are found to be shifted, and sizes they are found to be reduced to.
_SHIFTS, _SIZES = range(-60, 61, 2), (2, 4)
Depth = NDArray[np.float32]


@dataclass(frozen=True)
class Position:
    """Where a map's first pixel lies in the full image (row, column), and how one calls it."""

    top: int
    left: int
    name: str


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


def require_fit(depth: Depth, lidar: Depth, where: str | Path) -> None:
    """Raises DataError for a map (h, w) that does not fit the LiDAR (H, W), both metres with 0 = none.

    h x w may be smaller: then it is a crop, at the bottom centre. The message names the unit, size or shift that fits.
    Maps with fewer than 50 values at LiDAR pixels are not judged.
    """
    given = standard_positions(_size(depth), _size(lidar))[0]
    share = agreement(depth, lidar, given, LOOSE)
    if share is None or share >= _GOOD:
        return
    expected, told = (
        "a depth map that fits the frame's LiDAR within 10 %",
        f"only {100 * share:.0f} % of the LiDAR's pixels",
    )
    found, explanation, hint = max(_explanations(depth, lidar, given))
    if found > max(_FITS, share + _BETTER):
        raise DataError(where, expected, f"{told}, but {explanation} {100 * found:.0f} %", hint)
    if share < _LEAST:
        hint = "another frame's map, or no depth? augment.check_depth=false takes it as it is"
        raise DataError(where, expected, told, hint)


def _explanations(depth: Depth, lidar: Depth, given: Position) -> Iterator[tuple[float, str, str]]:
    """(share that fits, what it is read as, what to do) for every known slip."""
    for unit, factor in UNITS.items():
        scaled = (depth * np.float32(factor)).astype(np.float32)
        yield _share(scaled, lidar, given), f"read as {unit}", "write metres x 256"
    height, width = _size(lidar)
    for part in _SIZES:
        if abs(depth.shape[0] * part - height) <= part and abs(depth.shape[1] * part - width) <= part:
            rows = (np.arange(height) // part).clip(max=depth.shape[0] - 1)
            columns = (np.arange(width) // part).clip(max=depth.shape[1] - 1)
            whole = _share(depth[np.ix_(rows, columns)], lidar, Position(0, 0, "in place"))
            yield whole, f"as the image at 1/{part} of its size", f"write maps of {width} x {height}"
    hint = "write the map where its crop was taken"
    for position in standard_positions(_size(depth), _size(lidar))[1:]:
        yield _share(depth, lidar, position), f"at {position.name}", hint
    for shift in filter(None, _SHIFTS):
        moved = Position(given.top + shift, given.left, "")
        yield _share(depth, lidar, moved), f"{abs(shift)} rows {'lower' if shift > 0 else 'higher'}", hint


def _share(depth: Depth, lidar: Depth, position: Position) -> float:
    return agreement(depth, lidar, position, LOOSE) or 0.0


def _size(depth: Depth) -> tuple[int, int]:
    return depth.shape[0], depth.shape[1]
