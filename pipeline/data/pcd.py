"""PCD files as programs write them: ascii, binary, binary_compressed; fields of several values, padding between them.

Open3D's reader keeps x y z and colours of a file and drops the intensity, so this one is our own. Sources: the PCD 0.7
format page of the Point Cloud Library; the LZF format of Marc Lehmann's liblzf.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError

PADDING = "_"
_LETTERS = {"F": "f", "I": "i", "U": "u"}
_MOST_VALUES = 4096


@dataclass(frozen=True)
class PcdHeader:
    """What stands before the data.

    names   of the fields, "_" for padding
    types   NumPy type of a value of each field
    counts  values per point of each field
    points  rows
    kind    ascii, binary or binary_compressed
    """

    names: tuple[str, ...]
    types: tuple[str, ...]
    counts: tuple[int, ...]
    points: int
    kind: str

    @property
    def row(self) -> np.dtype[Any]:
        """One point in binary data, padding included."""
        return np.dtype([(f"f{i}", kind, (count,)) for i, (kind, count) in enumerate(zip(self.types, self.counts))])

    @property
    def columns(self) -> list[tuple[int, int, str]]:
        """(field, value in the field, name) of every column that is no padding; padding has no name."""
        found = []
        for i, (name, count) in enumerate(zip(self.names, self.counts)):
            values = range(count) if name != PADDING else ()
            found += [(i, k, name if count == 1 else f"{name}_{k}") for k in values]
        return found


def parse_header(lines: list[str], path: Path) -> PcdHeader:
    """The header lines of a PCD file. POINTS may be missing (WIDTH x HEIGHT) and so may COUNT (1 for every field)."""
    rows = {words[0].upper(): words[1:] for words in (line.split() for line in lines) if words and words[0][0] != "#"}
    try:
        names = tuple(rows.get("FIELDS") or rows["COLUMNS"])
        counts = tuple(map(int, rows.get("COUNT", ["1"] * len(names))))
        types = tuple(np.dtype(f"<{_LETTERS[t.upper()]}{int(s)}").str for t, s in zip(rows["TYPE"], rows["SIZE"]))
        points = int(rows["POINTS"][0]) if "POINTS" in rows else int(rows["WIDTH"][0]) * int(rows["HEIGHT"][0])
        kind = rows["DATA"][0].lower()
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise DataError(path, "a PCD header (FIELDS SIZE TYPE COUNT POINTS DATA)", f"trouble with {error}") from None
    if not len(names) == len(types) == len(counts):
        found = f"{len(names)} names, {len(types)} types, {len(counts)} counts"
        raise DataError(path, "as many FIELDS as SIZE, TYPE and COUNT", found)
    if points < 0 or min(counts, default=0) < 0 or sum(counts) > _MOST_VALUES:
        raise DataError(path, "a number of points and values", f"{points} points, COUNT {counts}")
    if kind not in ("ascii", "binary", "binary_compressed"):
        raise DataError(path, "PCD data 'ascii', 'binary' or 'binary_compressed'", kind)
    return PcdHeader(names, types, counts, points, kind)


def read_data(header: PcdHeader, data: memoryview, path: Path) -> tuple[NDArray[np.float32], list[str]]:
    """(points, columns) float32 values and the names of the columns behind a header."""
    columns = header.columns
    names = [name for _, _, name in columns]
    if header.kind == "ascii":
        return _ascii(header, data.tobytes(), path), names
    if header.kind == "binary":
        size = header.points * header.row.itemsize
        if len(data) < size:
            expected = f"{header.points} points of {header.row.itemsize} bytes"
            raise DataError(path, expected, f"{len(data)} bytes", "the file is truncated")
        rows = np.frombuffer(data[:size], dtype=header.row, count=header.points if size else 0)
        values = [rows[f"f{i}"][:, k] for i, k, _ in columns]
    else:
        fields = _decompressed_fields(header, data, path)
        values = [fields[i][:, k] for i, k, _ in columns]
    points = np.empty((header.points, len(values)), np.float32)
    for index, column in enumerate(values):
        points[:, index] = column
    return points, names


def _ascii(header: PcdHeader, data: bytes, path: Path) -> NDArray[np.float32]:
    """Padding is written as values like any other."""
    width = sum(header.counts)
    words = data.split()[: header.points * width]
    if len(words) != header.points * width:
        raise DataError(path, f"{header.points} points of {width} values", f"{len(words)} values")
    try:
        table = np.array(words, dtype=np.float64).reshape(header.points, width)
    except ValueError as error:
        raise DataError(path, "numbers", str(error)) from None
    starts = np.cumsum([0, *header.counts])
    return table[:, [int(starts[i]) + k for i, k, _ in header.columns]].astype(np.float32)


def _decompressed_fields(header: PcdHeader, data: memoryview, path: Path) -> dict[int, NDArray[Any]]:
    """Field -> (points, count) values: compressed data holds one field after the other, padding mostly left out."""
    packed, unpacked = struct.unpack_from("<II", data) if len(data) >= 8 else (0, 0)
    sizes = [np.dtype(kind).itemsize * count * header.points for kind, count in zip(header.types, header.counts)]
    stored = [i for i, name in enumerate(header.names) if name != PADDING]
    if unpacked == sum(sizes):
        stored = list(range(len(sizes)))
    if unpacked != sum(sizes[i] for i in stored) or len(data) < 8 + packed:
        expected = f"{header.points} points of {sum(sizes) // max(header.points, 1)} bytes"
        raise DataError(path, expected, f"{unpacked} bytes packed in {len(data)}", "the file is truncated")
    plain = np.zeros(unpacked, np.uint8)
    if _lzf(np.frombuffer(data, np.uint8, packed, 8), plain) != unpacked:
        raise DataError(path, "LZF data of a PCD file", "data that cannot be unpacked")
    fields, start = {}, 0
    for i in stored:
        block = plain[start : start + sizes[i]]
        fields[i] = block.view(header.types[i]).reshape(header.points, header.counts[i])
        start += sizes[i]
    return fields


@numba.njit(cache=True)
def _lzf(packed: NDArray[np.uint8], plain: NDArray[np.uint8]) -> int:
    """Unpacks into `plain`; the bytes written, -1 when the data does not fit.

    A control byte below 32 is followed by that many literal bytes and one; others say length and distance of a copy.
    """
    i, o = 0, 0
    while i < len(packed):
        control = int(packed[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > len(packed) or o + length > len(plain):
                return -1
            plain[o : o + length] = packed[i : i + length]
            i, o = i + length, o + length
            continue
        length = control >> 5
        if length == 7:
            if i >= len(packed):
                return -1
            length += int(packed[i])
            i += 1
        if i >= len(packed):
            return -1
        start = o - ((control & 31) << 8) - int(packed[i]) - 1
        i += 1
        if start < 0 or o + length + 2 > len(plain):
            return -1
        for k in range(length + 2):  # source and target may overlap
            plain[o + k] = plain[start + k]
        o += length + 2
    return o
