"""KITTI's .bin clouds: float32 rows without a header."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError
from pipeline.base.files import read_bytes
from pipeline.data.cloud_columns import CloudForm, advice, fitting_columns, is_text

# A return farther than this is damage: the sensor ends at 120 m.
MAX_COORDINATE = 10_000.0
_WHAT = "a velodyne cloud (float32 x y z intensity)"
# KITTI's intensities are never below 0; coordinates read as intensities are, half of the time.
_MANY_NEGATIVE = 0.01
_KITTI = CloudForm()


def read_velodyne(path: str | Path, form: CloudForm = _KITTI) -> NDArray[np.float32]:
    """(N, 4) float32 x y z intensity in the LiDAR frame, metres; intensity 0 in a cloud of 3 columns.

    form  columns of the folder's clouds (see `cloud_columns`)
    Raises DataError when the file is missing, empty, no whole rows, of another row length, or holds NaN, infinite or
    absurdly distant coordinates.
    """
    path = Path(path)
    points = _first_four(read_rows(path, form))
    # Minimum and maximum show NaN and infinity without a second array of the cloud's size.
    if len(points) and not np.isfinite([points.min(), points.max()]).all():
        bad = ~np.isfinite(points).all(axis=1)
        found = (
            f"{int(bad.sum())} of {len(points)} points with NaN or infinite values (first: point {int(bad.argmax())})"
        )
        raise DataError(path, f"{_WHAT} of finite numbers", found)
    largest = float(max(-points[:, :3].min(), points[:, :3].max()))
    if largest > MAX_COORDINATE:
        raise DataError(
            path, f"coordinates within {MAX_COORDINATE:g} m", f"{largest:g} m", "is it float32 x y z intensity?"
        )
    return points


def read_rows(path: Path, form: CloudForm = _KITTI) -> NDArray[np.float32]:
    """(N, C) the rows of a .bin file as stored. Raises DataError for another row length than `form.columns`."""
    data = read_bytes(path, _WHAT)
    if is_text(data):
        raise DataError(path, _WHAT, f"a text file that begins {data[:24]!r}")
    if form.refusal:
        raise DataError(
            path, f"{form.columns} float32 columns a point (x y z intensity)", form.refusal, advice(form.fits)
        )
    rows = np.frombuffer(data[: len(data) // 4 * 4], dtype="<f4")
    whole = len(data) % (4 * form.columns) == 0
    if not form.asked and not (whole and _may_be_intensities(rows.reshape(-1, form.columns)[:, -1])):
        fits = fitting_columns(rows)
        if fits is not None and fits != form.columns:
            found = f"{fits} float32 columns a point"
            raise DataError(
                path, f"{form.columns} float32 columns a point, as in the other clouds", found, advice(fits)
            )
    if not whole:
        hint = "it is truncated, or it has other columns (nuScenes has 5, plain XYZ has 3)"
        raise DataError(path, f"{_WHAT}: a multiple of {4 * form.columns} bytes", f"{len(data)} bytes", hint)
    return rows.reshape(-1, form.columns)


def _may_be_intensities(values: NDArray[np.float32]) -> bool:
    return bool((values < 0).mean() < _MANY_NEGATIVE)


def _first_four(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    if rows.shape[1] < 4:
        return np.column_stack([rows, np.zeros(len(rows), np.float32)])
    return np.ascontiguousarray(rows[:, :4], dtype=np.float32)
