"""Point cloud files: KITTI .bin, .npy, PLY and PCD, read and written with named columns.

PLY and PCD are written as binary little-endian float32, one property or field per column, so that every per-point
column of an augmented cloud (sigma, surfaces, source, ...) reaches the viewer. Sources: Turk, "The PLY polygon file
format", 1994; the PCD 0.7 format page of the Point Cloud Library.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from auglidar_base.array_files import ArrayFileError, npy_array
from pipeline.base.errors import DataError
from pipeline.data.bin_clouds import read_velodyne
from pipeline.data.cloud_columns import CloudForm
from pipeline.data.images import read_bytes
from pipeline.data.pcd import parse_header, read_data

SUFFIXES = (".bin", ".npy", ".ply", ".pcd")
_PLY_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
# Names of the intensity in small letters, of which the first that a file has counts.
INTENSITY_NAMES = ("intensity", "scalar_intensity", "reflectivity", "reflectance", "remission", "remissions", "i")
# A header longer than this is not a header.
_MAX_HEADER = 65536
_MOST_COLUMNS = 256
_KITTI = CloudForm()


@dataclass(frozen=True)
class Cloud:
    """values (N, C) float32 and the names of the C columns, x y z first."""

    values: NDArray[np.float32]
    columns: tuple[str, ...]

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape[1] != len(self.columns):
            raise ValueError(f"cloud: {self.values.shape} values do not fit the columns {self.columns}")

    def column(self, name: str) -> NDArray[np.float32]:
        """(N,) one column by name."""
        return self.values[:, self.columns.index(name)]


def read_points(path: str | Path, form: CloudForm = _KITTI) -> NDArray[np.float32]:
    """(N, 4) float32 x y z intensity of a .bin, .npy, .ply or .pcd file; intensity 0 when the file has none.

    Pixels of organised PLY and PCD clouds without a return (NaN, or 0 0 0) are left out, unless `form` keeps them;
    then NaN is refused.
    """
    path = Path(path)
    if path.suffix.lower() == ".bin":
        return read_velodyne(path, form)
    points, _ = read_measured(path, form)
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points)).any(axis=1).sum())
        raise DataError(path, "finite points", f"{bad} of {len(points)} points with NaN or infinite values")
    return points


def read_measured(path: Path, form: CloudForm = _KITTI) -> tuple[NDArray[np.float32], int]:
    """(N, 4) x y z intensity of a .npy, .ply or .pcd file, and how many points without a return were left out."""
    cloud = read_cloud(path)
    small = [name.lower() for name in cloud.columns]
    wanted = [small.index(name) for name in ("x", "y", "z")]
    wanted += [small.index(name) for name in INTENSITY_NAMES if name in small][:1]
    points = cloud.values
    if wanted != list(range(4)) or points.shape[1] != 4:
        points = np.zeros((len(cloud.values), 4), np.float32)
        points[:, : len(wanted)] = cloud.values[:, wanted]
    if path.suffix.lower() == ".npy" or form.keep_empty:
        return points, 0
    empty = np.isnan(points[:, :3]).any(axis=1) | (points[:, :3] == 0).all(axis=1)
    count = int(empty.sum())
    return np.ascontiguousarray(points[~empty] if count else points), count


def read_cloud(path: str | Path) -> Cloud:
    """All columns of a .npy, .ply or .pcd file. Raises DataError on damage or an unknown format."""
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES[1:]:
        raise DataError(path, f"a point cloud ({', '.join(SUFFIXES)})", f"a {path.suffix or 'nameless'} file")
    data = read_bytes(path, "a point cloud")
    if path.suffix.lower() == ".npy":
        return _read_npy(data, path)
    try:
        # Numbers beyond float32 become infinite here; `read_points` refuses them.
        with np.errstate(over="ignore", invalid="ignore"):
            cloud = _read_ply(data, path) if path.suffix.lower() == ".ply" else _read_pcd(data, path)
    except (IndexError, ValueError, TypeError, OverflowError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(path, f"a whole {path.suffix} header", f"words that make none ({error})") from None
    if not {"x", "y", "z"} <= {name.lower() for name in cloud.columns}:
        raise DataError(path, "columns x y z", ", ".join(cloud.columns))
    return cloud


def _read_npy(data: bytes, path: Path) -> Cloud:
    try:
        array = npy_array(data)
    except ArrayFileError as error:
        raise DataError(path, "a .npy array of numbers", str(error)) from None
    if array.dtype.kind not in "biuf":
        raise DataError(path, "a .npy array of numbers", f"an array of {array.dtype}")
    if array.ndim != 2 or not 3 <= array.shape[1] <= _MOST_COLUMNS:
        raise DataError(path, "an (N, 3 or more) array", f"shape {array.shape}")
    names = ("x", "y", "z", "intensity", *(f"column{i}" for i in range(4, array.shape[1])))
    # Numbers beyond float32 become infinite here; `read_points` refuses them.
    with np.errstate(over="ignore", invalid="ignore"):
        return Cloud(array.astype(np.float32, copy=False), names[: array.shape[1]])


def ply_bytes(cloud: Cloud) -> bytes:
    """A binary little-endian PLY with one float property per column."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(cloud.values)}"]
    lines += [f"property float {name}" for name in cloud.columns]
    header = "\n".join([*lines, "end_header"]) + "\n"
    return header.encode("ascii") + np.ascontiguousarray(cloud.values, dtype="<f4").tobytes()


def pcd_bytes(cloud: Cloud) -> bytes:
    """A binary PCD 0.7 file with one float32 field per column."""
    count, fields = len(cloud.values), len(cloud.columns)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(cloud.columns)}\nSIZE {' '.join(['4'] * fields)}\nTYPE {' '.join(['F'] * fields)}\n"
        f"COUNT {' '.join(['1'] * fields)}\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\n"
        "DATA binary\n"
    )
    return header.encode("ascii") + np.ascontiguousarray(cloud.values, dtype="<f4").tobytes()


def _header(data: bytes, last: bytes, path: Path) -> tuple[list[str], int]:
    """Lines of a text header up to the line starting with `last`, and the offset behind it."""
    start = data.find(last, 0, _MAX_HEADER)
    end = data.find(b"\n", start, start + 200) if start >= 0 else -1
    if end < 0:
        raise DataError(path, f"a header that ends with '{last.decode()}'", f"a file starting with {data[:8]!r}")
    return data[:end].decode("latin-1").splitlines(), end + 1


def _read_ply(data: bytes, path: Path) -> Cloud:
    lines, offset = _header(data, b"end_header", path)
    count, kind, element = 0, "", ""
    names: list[str] = []
    types: list[str] = []
    for words in (line.split() for line in lines):
        if words[:1] == ["format"]:
            kind = words[1]
        elif words[:1] == ["element"]:
            element = words[1]
            if element != "vertex" and not names:
                raise DataError(path, "the vertices first", f"element {element}")
            count = int(words[2]) if element == "vertex" else count
        elif words[:1] == ["property"] and element == "vertex":
            if words[1].lower() not in _PLY_TYPES:
                raise DataError(path, "number properties of the vertices", " ".join(words))
            names.append(words[-1])
            types.append(_PLY_TYPES[words[1].lower()])
    order = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}.get(kind)
    if order is None or not names:
        raise DataError(path, "a PLY file with vertices", f"format {kind or 'unknown'} with {len(names)} properties")
    return _table(data, offset, count, names, [order + t if order else t for t in types], kind == "ascii", path)


def _read_pcd(data: bytes, path: Path) -> Cloud:
    lines, offset = _header(data, b"DATA ", path)
    values, names = read_data(parse_header(lines, path), memoryview(data)[offset:], path)
    return Cloud(values, tuple(names))


def _table(data: bytes, offset: int, count: int, names: list[str], types: list[str], text: bool, path: Path) -> Cloud:
    """The rows behind a header, as float32 columns."""
    if count < 0:
        raise DataError(path, "a number of points", f"{count}")
    if text:
        words = data[offset:].split()[: count * len(names)]
        if len(words) != count * len(names):
            raise DataError(path, f"{count} points of {len(names)} values", f"{len(words)} values")
        try:
            table = np.array(words, dtype=np.float64).reshape(count, len(names))
        except ValueError as error:
            raise DataError(path, "numbers", str(error)) from None
        return Cloud(table.astype(np.float32), tuple(names))
    row = np.dtype([(f"c{index}", kind) for index, kind in enumerate(types)])
    rest = len(data) - offset
    if rest < count * row.itemsize:
        raise DataError(path, f"{count} points of {row.itemsize} bytes", f"{rest} bytes", "the file is truncated")
    rows = np.frombuffer(data, row, count, offset) if count else np.zeros(0, row)
    values = np.empty((count, len(names)), np.float32)
    for index in range(len(names)):
        values[:, index] = rows[f"c{index}"]
    return Cloud(values, tuple(names))
