"""NumPy's .npy and .npz from elsewhere: sizes are looked at before anything is unpacked, and damage is one error.

A .npy is a header and bytes. NumPy evaluates the header as Python and fails in a dozen ways; here it has a fixed
grammar (numpy.lib.format in NumPy's manual), and the array is a view of the bytes, which are not copied. A .npz is a
zip of them: a few kilobytes of it may unpack to terabytes.
"""

from __future__ import annotations

import io
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Unpacked, all arrays of a file together.
MOST_BYTES = 512 * 1024 * 1024
_MOST_HEADER = 10_000
# An array without values may claim any other length; a loop over its columns would not end.
_MOST_EMPTY = 10_000
_HEADER = re.compile(
    r"\{\s*'descr'\s*:\s*'(?P<dtype>[<>|=]?(?:b1|[iu][1248]|f[248]|c(?:8|16)|[SU][1-9][0-9]{0,4}))'\s*,"
    r"\s*'fortran_order'\s*:\s*(?P<columns_first>True|False)\s*,"
    r"\s*'shape'\s*:\s*\((?P<shape>[0-9L,\s]{0,400})\)\s*,?\s*\}\s*"
)
_DAMAGE = (ValueError, EOFError, OSError, RuntimeError, NotImplementedError, zipfile.BadZipFile, zlib.error)


class ArrayFileError(ValueError):
    """A .npy or .npz that cannot be read: the reason, without the name of the file."""


def npy_array(data: bytes) -> NDArray[Any]:
    """The array in the bytes of a .npy, not writable. Raises ArrayFileError when it is damaged or holds objects."""
    if data[:6] != b"\x93NUMPY" or len(data) < 12:
        raise ArrayFileError(f"a file starting with {data[:6]!r}")
    version, start = data[6], 10
    (length,) = struct.unpack_from("<H", data, 8)
    if version in (2, 3):
        (length,) = struct.unpack_from("<I", data, 8)
        start = 12
    elif version != 1:
        raise ArrayFileError(f"version {version} of the format")
    if length > _MOST_HEADER:
        raise ArrayFileError(f"a header of {length} bytes")
    found = _HEADER.fullmatch(data[start : start + length].decode("latin-1"))
    if found is None:
        raise ArrayFileError(f"the header {data[start : start + min(length, 80)]!r}")
    shape = _shape(found["shape"])
    order = "F" if found["columns_first"] == "True" else "C"
    return _array(data, start + length, np.dtype(found["dtype"]), shape).reshape(shape, order=order)  # type: ignore[call-overload]


def _shape(text: str) -> tuple[int, ...]:
    words = [word.strip().rstrip("L") for word in text.split(",")]
    if words[-1] == "":
        words.pop()
    if len(words) > 32 or not all(word.isdecimal() and len(word) <= 18 for word in words):
        raise ArrayFileError(f"the shape ({text[:80]})")
    return tuple(int(word) for word in words)


def _array(data: bytes, start: int, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    count = math.prod(shape)
    if len(data) - start < count * dtype.itemsize:
        raise ArrayFileError(f"{len(data) - start} bytes for {count} values of {dtype.itemsize}: truncated?")
    if count == 0 and max(shape) > _MOST_EMPTY:
        raise ArrayFileError(f"no value, and a shape of {max(shape)}")
    return np.frombuffer(data, dtype, count, start) if count else np.zeros(0, dtype)


def npz_arrays(data: bytes, names: Iterable[str] | None = None, most: int = MOST_BYTES) -> dict[str, NDArray[Any]]:
    """Arrays in the bytes of a .npz, not writable: those of `names`, or all.

    most  bytes that they may have together, unpacked
    Raises ArrayFileError when the file is damaged or encrypted, lacks a name, or would unpack to more.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            wanted = list(entries) if names is None else list(names)
            missing = [name for name in wanted if name not in entries]
            if missing:
                raise ArrayFileError(f"no array {missing[0]!r}, only {', '.join(list(entries)[:8]) or 'none'}")
            size = sum(entries[name].file_size for name in wanted)
            if size > most:
                raise ArrayFileError(f"arrays that unpack to {size / 1e6:,.0f} MB, more than {most / 1e6:,.0f} MB")
            return {name: npy_array(_unpacked(archive, entries[name])) for name in wanted}
    except ArrayFileError:
        raise
    except MemoryError:
        raise ArrayFileError("arrays that take more memory than there is") from None
    except _DAMAGE as error:
        raise ArrayFileError(" ".join(str(error).split())[:200] or type(error).__name__) from None


def _unpacked(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    if entry.flag_bits & 1:
        raise ArrayFileError(f"the encrypted entry {entry.filename[:80]!r}")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ArrayFileError(f"an entry packed by method {entry.compress_type}")
    with archive.open(entry) as file:
        return file.read(entry.file_size)  # no more than the header said, whatever is in there
