"""Pickles are data or refused: what other projects write is read, what lies about memory is not."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from auglidar_base.inert_pickle import RefusedError, loads
from pipeline.cli import main
from tests.auglidar_base.forged_pickles import FORGED, forged

VECTOR = np.arange(6.0)
# What infos and results of OpenPCDet and mmdetection3d are made of.
CONTENTS: dict[str, Any] = {
    "name": np.array(["Car", "Pedestrian", "é"]),
    "boxes": np.ones((2, 7), np.float32),
    "none": np.zeros((0, 7), np.float32),
    "columns first": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "big-endian": np.arange(3, dtype=">i4"),
    "big-endian text": np.array(["é"], dtype=">U3"),
    "no dimension": np.array(5),
    "truth": np.array([True, False]),
    "any objects": np.array(["a", None, 3], dtype=object),
    "score": np.float32(0.25),
    "one name": np.str_("Van"),
    np.str_("key"): -(2**40),
    "twice": [VECTOR, VECTOR, VECTOR[::2]],
    "plain": (1, 2.5, None, True, "é", b"x\xff", b"", {"categories": {"Car": 2}}),
}


def assert_same(found: Any, expected: Any) -> None:
    assert type(found) is type(expected)
    if isinstance(expected, np.ndarray):
        assert (found.dtype, found.shape, found.flags.writeable) == (expected.dtype, expected.shape, True)
        assert found.tolist() == expected.tolist()
    elif isinstance(expected, dict):
        assert list(found) == list(expected)
        assert_same(list(found.values()), list(expected.values()))
    elif isinstance(expected, (list, tuple)):
        assert len(found) == len(expected)
        for pair in zip(found, expected):
            assert_same(*pair)
    else:
        assert found == expected


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_infos_are_read_in_every_protocol(protocol: int) -> None:
    found = loads(pickle.dumps([CONTENTS], protocol=protocol))
    assert_same(found, [CONTENTS])
    assert found[0]["twice"][0] is found[0]["twice"][1]


def test_python_2_wrote_arrays_as_text() -> None:
    head = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR(I1\n(I2\nt"
    head += b"cnumpy\ndtype\n(S'u2'\nI0\nI1\ntR"
    state = b"(I3\nS'<'\nNNNI-1\nI-1\nI0\ntbI00\nU\x04\x01\x00\xff\x80tb."
    assert_same(loads(head + state), np.array([1, 0x80FF], dtype=np.uint16))


_TYPES = st.one_of(
    arrays.integer_dtypes(endianness="?"),
    arrays.unsigned_integer_dtypes(endianness="?"),
    arrays.floating_dtypes(endianness="?", sizes=(16, 32, 64)),
    arrays.boolean_dtypes(),
    arrays.unicode_string_dtypes(endianness="?", max_len=4),
)


@settings(max_examples=60, deadline=None)
@given(
    arrays.arrays(_TYPES, arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3)),
    st.integers(0, pickle.HIGHEST_PROTOCOL),
)
def test_any_array_survives(array: np.ndarray, protocol: int) -> None:
    found = loads(pickle.dumps(array, protocol=protocol))
    assert (found.dtype, found.shape) == (array.dtype, array.shape)
    assert found.tobytes() == array.tobytes()


@pytest.mark.parametrize("name", FORGED)
def test_a_forged_array_is_refused(name: str) -> None:
    with pytest.raises(RefusedError):
        loads(forged(name))


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"cos\nsystem\n(S'true'\ntR.", r"os\.system"),
        (b"cnumpy\nload\n(S'x'\ntR.", r"numpy\.load"),
        (b"\x8c\x05numpy\x8c\x04load\x93.", r"numpy\.load"),
        (b"cnumpy\nndarray\n.", "in the place of data"),
        (b"h\xff.", "value 255, which it did not store"),
        (b"j\xff\xff\xff\x7f.", "did not store"),
        (b"]q\x00h\x00a.", "holds itself"),
        (b"]" + b"q\x00(h\x00h\x00l" * 40 + b".", "again and again"),
        (b"]" * 100 + b"a" * 99 + b".", "levels deep"),
        (b"}(" + b")" + b"\x85" * 200_000 + b"Nu.", "a tuple as a key"),
        (b"\x8f(" + b")" + b"\x85" * 200_000 + b"\x90.", "a tuple as a key"),
        (b"\x8a\xff" + b"\x7f" * 255 + b".", "more than 64 bits"),
        (b"I" + b"9" * 400 + b"\n.", "more than 64 bits"),
        (b"\x8e" + b"\xff" * 7 + b"\x7f.", r"bytes|expected"),
        (b"(K\x01d.", "a key without a value"),
        (b"K\x01K\x02a.", "no list"),
        (b"(.", "too early"),
        (b"0.", "too early"),
        (b"e.", "too early"),
        (b"", "pickle exhausted"),
        (b"Pname\n.", "PERSID"),
        (b"\x82\x01.", "EXT1"),
        (b"X\x03\x00\x00\x00\xed\xa0\x80.", "surrogates not allowed"),
    ],
)
def test_odd_files_end_in_one_line(data: bytes, reason: str) -> None:
    with pytest.raises(RefusedError, match=reason) as caught:
        loads(data)
    assert "\n" not in str(caught.value)


def test_a_huge_memo_index_takes_no_memory() -> None:
    assert loads(b"K\x07r\xff\xff\xff\x7f0j\xff\xff\xff\x7f.") == 7


def test_the_same_bytes_stated_again_and_again_are_refused() -> None:
    data = b"B" + (1_000_000).to_bytes(4, "little") + b"a" * 1_000_000 + b"q\x63"
    made = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tU\x01btR"
    filled = b"(K\x01(J\x40\x42\x0f\x00tcnumpy\ndtype\n(U\x02u1K\x00K\x01tRK\x00h\x63tb"
    assert len(loads(b"(" + data + (made + filled) * 2 + b"t.")) == 3
    with pytest.raises(RefusedError, match="more memory than the file accounts for"):
        loads(b"(" + data + (made + filled) * 40 + b"t.")


@pytest.mark.parametrize("name", ["a field far outside the item", "too few objects"])
def test_the_command_line_says_so_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    path = tmp_path / "result.pkl"
    path.write_bytes(forged(name))
    out = str(tmp_path / "out")
    assert main(["--stage", "import", str(path), "--architecture", "results", "--out", out]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "result.pkl: expected a pickle of lists, dicts, numbers and arrays" in said
