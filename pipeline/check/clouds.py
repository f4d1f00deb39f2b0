"""Checks of one point cloud."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError
from pipeline.check.faults import Finding
from pipeline.data.bin_clouds import MAX_COORDINATE, read_rows
from pipeline.data.cloud_columns import CloudForm

# LiDARs of cars end at 120-250 m; the median return of a street lies at 10-20 m.
_MILLIMETRE_MEDIAN = 300.0
# Beyond this share of values that float16 holds exactly, the cloud went through float16 (measured: 0.0-0.3 % on KITTI).
_FLOAT16_SHARE = 0.99
_FEWEST = 100
# No LiDAR of a car gives so few points.
_NO_CLOUD = 20


@dataclass(frozen=True)
class CloudFacts:
    """Numbers of one cloud that are compared over the frames.

    count  points
    floor  elevation in degrees below which 2 % of the points lie (a whole KITTI cloud: -18 to -20)
    """

    count: int
    floor: float


def read_raw_cloud(path: Path, form: CloudForm, frame: str) -> tuple[NDArray[np.float32] | None, list[Finding]]:
    """(N, 4) values of a .bin file as stored, or None with the reason why they cannot be used."""
    try:
        rows = read_rows(path, form)
    except DataError as error:
        message = f"expected {error.expected}, got {error.found}; {error.hint}".removesuffix("; ")
        return None, [Finding(_file_fault(error), frame, str(path), message)]
    return rows[:, :4], []


def _file_fault(error: DataError) -> str:
    """The fault of a .bin file that is no rows."""
    if error.found == "an empty file":
        return "empty_file"
    if error.found.endswith("columns a point"):
        return "wrong_columns"
    return "truncated_cloud" if error.found.endswith(" bytes") else "unreadable_file"


def check_cloud(points: NDArray[np.floating], frame: str, where: str) -> list[Finding]:
    """Faults of a cloud's contents; points (N, 3+) x y z [intensity ...], LiDAR frame, metres. One cause at most."""
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        message = f"{int(bad.sum())} of {len(points)} points hold NaN or infinite values (first: {int(bad.argmax())})"
        return [Finding("non_finite_points", frame, where, message)]
    if len(points) < _FEWEST:
        return [Finding("truncated_cloud", frame, where, f"{len(points)} points")] if len(points) < _NO_CLOUD else []
    distance = np.linalg.norm(points[:, :3].astype(np.float64), axis=1)
    middle = float(np.median(distance))
    if middle > _MILLIMETRE_MEDIAN:
        message = f"half of the points are farther than {middle:.0f} m"
        return [Finding("cloud_in_millimetres", frame, where, message)]
    wild = np.abs(points[:, :3]).max(axis=1) > MAX_COORDINATE
    if wild.any():
        message = (
            f"{int(wild.sum())} of {len(points)} points lie beyond {MAX_COORDINATE:g} m (first: {int(wild.argmax())})"
        )
        return [Finding("non_finite_points", frame, where, message)]
    found = _zeros(distance == 0, frame, where)
    if found:
        return found
    order = _vertical_axis(points)
    if order != 2:
        message = f"the flat axis is {'xyz'[order]} (column {order + 1}), expected z (column 3)"
        return [Finding("axis_order", frame, where, message)]
    if points.dtype == np.float32 and _float16_share(points) > _FLOAT16_SHARE:
        share = 100 * _float16_share(points)
        return [Finding("float16_loss", frame, where, f"{share:.1f} % of the coordinates are exact float16 values")]
    if points.shape[1] > 3 and float(np.percentile(points[:, 3], 99)) > 1.5:
        message = f"1 % of the intensities exceed {float(np.percentile(points[:, 3], 99)):.4g}, expected 0..1"
        return [Finding("intensity_scale", frame, where, message)]
    return []


def _zeros(zero: NDArray[np.bool_], frame: str, where: str) -> list[Finding]:
    """Many points 0 0 0: the rest of a file that was not written to its end, or returns that did not come back."""
    nowhere, count = int(zero.sum()), len(zero)
    if nowhere <= 0.1 * count:
        return []
    tail = count if zero.all() else int(np.argmin(zero[::-1]))
    if tail > 0.5 * nowhere:
        message = f"the last {tail} of {count} points are 0 0 0: the file was not written to its end"
        return [Finding("truncated_cloud", frame, where, message)]
    message = f"{nowhere} of {count} points are 0 0 0, between the others"
    return [Finding("zero_returns", frame, where, message)]


def _vertical_axis(points: NDArray[np.floating]) -> int:
    """The column in which a street is flat: the smallest spread between the 10th and 90th percentile.

    2 unless another column is much flatter, so that narrow canyons and indoor rooms do not count.
    """
    low, high = np.percentile(points[:, :3], [10, 90], axis=0)
    spread = high - low
    flattest = int(np.argmin(spread))
    return flattest if spread[flattest] < 0.6 * spread[2] else 2


def _float16_share(points: NDArray[np.floating]) -> float:
    """Share of the coordinates that float16 holds exactly, zeros left out."""
    values = points[:, :3][points[:, :3] != 0]
    if values.size == 0:
        return 0.0
    with np.errstate(over="ignore"):
        return float((values.astype(np.float16).astype(np.float32) == values).mean())


def cloud_facts(points: NDArray[np.floating]) -> CloudFacts:
    """The numbers of a sound cloud."""
    if len(points) == 0:
        return CloudFacts(0, 0.0)
    x, y, z = points[:, :3].astype(np.float64).T
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    return CloudFacts(len(points), float(np.percentile(elevation, 2)))
