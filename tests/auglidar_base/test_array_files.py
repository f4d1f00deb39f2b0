"""Arrays in .npy and .npz: NumPy's files are read as NumPy reads them, every damage is one error."""

from __future__ import annotations

import io
import zipfile
from typing import Any

import numpy as np
import pytest

from auglidar_base.array_files import ArrayFileError, npy_array, npz_arrays


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def with_header(header: str, body: bytes = b"\0" * 64, version: int = 1) -> bytes:
    text = header.encode()
    length = len(text).to_bytes(2 if version == 1 else 4, "little")
    return b"\x93NUMPY" + bytes([version, 0]) + length + text + body


def npz(size: int = 8, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        archive.writestr("a.npy", npy(np.zeros(size, np.uint8)))
    return stream.getvalue()


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6, dtype="<f4").reshape(2, 3),
        np.asfortranarray(np.arange(6, dtype=">i8").reshape(2, 3)),
        np.array(5.0),
        np.zeros((0, 4), np.float16),
        np.array([True, False]),
        np.array(["a", "bcd"]),
        np.arange(5, dtype=np.uint8),
    ],
)
def test_arrays_are_what_numpy_reads(array: np.ndarray) -> None:
    read = npy_array(npy(array))
    assert read.dtype == array.dtype
    assert read.shape == array.shape
    np.testing.assert_array_equal(read, array)


def test_a_large_array_is_a_view_of_the_bytes() -> None:
    data = npy(np.ones(10, np.float32))
    assert npy_array(data).base is not None
    assert not npy_array(data).flags.writeable


GOOD = "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }\n"
HEADERS = {
    "objects": npy(np.array([{}, 1], object)),
    "fields": npy(np.zeros(2, [("x", "<f4"), ("y", "<f4")])),
    "truncated": with_header(GOOD, b"\0" * 23),
    "no NumPy file": b"PK\x03\x04" + b"\0" * 30,
    "nothing": b"",
    "magic only": b"\x93NUMPY\x01\x00",
    "unknown version": with_header(GOOD, version=9),
    "header beyond the file": b"\x93NUMPY\x01\x00\xff\xff" + b"{",
    "header of 4 GB": b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + b"{",
    "no shape": with_header("{'descr': '<f4', 'fortran_order': False, }"),
    "negative shape": with_header(GOOD.replace("2, 3", "-2, 3")),
    "digits without end": with_header(GOOD.replace("2, 3", "9" * 5000)),
    "many digits": with_header(GOOD.replace("2, 3", "9" * 300)),
    "product beyond 64 bits": with_header(GOOD.replace("2, 3", "4294967296, 4294967296, 4294967296")),
    "an empty array of endless rows": with_header(GOOD.replace("2, 3", "0, 999999999999")),
    "an unknown dtype": with_header(GOOD.replace("<f4", "<q9")),
    "a dtype of no size": with_header(GOOD.replace("<f4", "<U0")),
    "a dtype that is code": with_header(GOOD.replace("'<f4'", "__import__('os')")),
    "nesting": with_header("(" * 5000),
    "a zero byte": with_header(GOOD.replace("descr", "des\0cr")),
    "not UTF-8": b"\x93NUMPY\x03\x00\x04\x00\x00\x00\xff\xfe\xfd\xfc",
}


@pytest.mark.parametrize("name", HEADERS)
def test_headers_of_every_kind_of_damage_are_one_error(name: str) -> None:
    with pytest.raises(ArrayFileError):
        npy_array(HEADERS[name])


def test_arrays_of_a_zip_by_name() -> None:
    stream = io.BytesIO()
    arrays: dict[str, Any] = {"a": np.arange(3), "scope/b": np.ones((2, 2))}
    np.savez_compressed(stream, **arrays)
    for names in (None, ("scope/b",)):
        found = npz_arrays(stream.getvalue(), names)
        assert list(found) == list(names or arrays)
        for name, value in found.items():
            np.testing.assert_array_equal(value, arrays[name])


def encrypted() -> bytes:
    """The flag of encryption in both headers, as Python cannot write such a file."""
    data = bytearray(npz())
    data[data.index(b"PK\x03\x04") + 6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    return bytes(data)


def damaged_stream() -> bytes:
    data = bytearray(npz())
    start = data.index(b"a.npy") + 5
    data[start : start + 4] = b"\xff\xff\xff\xff"
    return bytes(data)


def lying(size: int) -> bytes:
    """The directory says another size than what unpacks."""
    data = bytearray(npz())
    place = data.index(b"PK\x01\x02") + 24
    data[place : place + 4] = size.to_bytes(4, "little")
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "not a zip file"),
        (npz()[:-30], "not a zip file"),
        (damaged_stream(), "Error -3|invalid"),
        (encrypted(), "encrypted entry 'a.npy'"),
        (npz(method=zipfile.ZIP_BZIP2), "packed by method 12"),
        (npz(3_000_000), "unpack to 3 MB, more than 1 MB"),
        (lying(4), "CRC|starting with"),
        (lying(3_000_000_000), "unpack to 3,000 MB, more than 1 MB"),
    ],
)
def test_damaged_zips_are_one_error(data: bytes, said: str) -> None:
    with pytest.raises(ArrayFileError, match=said):
        npz_arrays(data, ("a",), most=1_000_000)


def test_a_missing_array_says_what_there_is() -> None:
    with pytest.raises(ArrayFileError, match="no array 'b', only a"):
        npz_arrays(npz(), ("b",))
