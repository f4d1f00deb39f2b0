"""NumPy arrays and scalars from the parts that a pickle states: checked as data, never handed to NumPy's unpickling.

NumPy's own `__setstate__` believes flags, offsets and fields of a file and follows pointers in it. Here a dtype comes
from a short string of a fixed grammar and a byte order, an array from bytes of exactly the right length.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

_DTYPE = re.compile(r"[<>|=]?(?:b1|[iu][1248]|f[248]|[SU][1-9][0-9]{0,5}|O8?)")
_OBJECT_FLAGS, _TEXT_FLAGS = 63, 8
# An array without values may claim any other length; a loop over its rows would not end.
_MOST_EMPTY_ROWS = 10_000


class RefusedError(ValueError):
    """The pickle is damaged or asks for what no data file needs."""


class StatedDtype:
    """A dtype as a pickle states it: its name first, the byte order afterwards."""

    def __init__(self, arguments: tuple[Any, ...]) -> None:
        """arguments  of numpy.dtype in the file: ("f8", False, True)"""
        if not (1 <= len(arguments) <= 3 and type(arguments[0]) is str and all(map(_is_flag, arguments[1:]))):
            raise RefusedError("a dtype that is no plain name")
        if not _DTYPE.fullmatch(arguments[0]):
            raise RefusedError(f"the dtype {arguments[0][:40]!r}")
        self.value: np.dtype[Any] = np.dtype(arguments[0])

    def set_state(self, state: Any) -> None:
        """state  (3, byte order, None, None, None, item size, alignment, flags); everything but the order is implied"""
        if not (type(state) is tuple and len(state) == 8 and all(_plain(part) for part in state)):
            raise RefusedError("a dtype with fields or a damaged state")
        version, order, *inner, size, alignment, flags = state
        text = self.value.kind in "SU"
        sizes = (self.value.itemsize, self.value.alignment) if text else (-1, -1)
        allowed = {"O": (_OBJECT_FLAGS,), "U": (0, _TEXT_FLAGS)}.get(self.value.kind, (0,))
        if version != 3 or inner != [None] * 3 or (size, alignment) != sizes or flags not in allowed:
            raise RefusedError("a dtype with fields or a damaged state")
        if order not in ("<", ">", "|", "="):
            raise RefusedError(f"the byte order {order!r}")
        self.value = self.value.newbyteorder(order)


def _is_flag(part: Any) -> bool:
    return type(part) in (bool, int) and part in (0, 1)


def _plain(part: Any) -> bool:
    return part is None or type(part) in (int, str)


def stated_array(shape: Any, dtype: Any, data: Any, order: str) -> NDArray[Any]:
    """A new array; `data` is bytes of exactly its length, for objects a list of exactly its values.

    order  "C" or "F". Raises RefusedError otherwise.
    """
    if not isinstance(dtype, StatedDtype):
        raise RefusedError("an array without a dtype")
    if not (type(shape) is tuple and len(shape) <= 32 and all(type(n) is int and n >= 0 for n in shape)):
        raise RefusedError("an array of a damaged shape")
    if dtype.value.hasobject:
        return _objects(shape, data, order)
    raw = _raw_bytes(data)
    expected = math.prod(shape) * dtype.value.itemsize
    if len(raw) != expected:
        raise RefusedError(f"an array of {expected} bytes with {len(raw)}")
    if not raw:
        return np.empty(_few_rows(shape), dtype.value)
    flat = np.frombuffer(raw, dtype.value)
    _check_values(flat)
    return flat.reshape(shape, order="F" if order == "F" else "C").copy(order="K")


def stated_scalar(arguments: tuple[Any, ...]) -> Any:
    """A NumPy scalar from (dtype, bytes)."""
    if len(arguments) != 2 or not isinstance(arguments[0], StatedDtype) or arguments[0].value.hasobject:
        raise RefusedError("a scalar of a damaged state")
    return stated_array((1,), *arguments, "C")[0]


def _raw_bytes(data: Any) -> bytes:
    if type(data) is str:  # Python 2 wrote bytes as text
        return data.encode("latin-1")
    if type(data) not in (bytes, bytearray):
        raise RefusedError("an array without bytes")
    return bytes(data)


def _few_rows(shape: tuple[int, ...]) -> tuple[int, ...]:
    if max(shape, default=0) > _MOST_EMPTY_ROWS:
        raise RefusedError(f"an empty array of {max(shape)} rows")
    return shape


def _objects(shape: tuple[int, ...], values: Any, order: str) -> NDArray[Any]:
    if type(values) is not list or len(values) != math.prod(shape):
        raise RefusedError("an array of objects with too few or too many")
    flat = np.empty(len(values), dtype=object)
    for index, value in enumerate(values):
        flat[index] = value
    return flat.reshape(_few_rows(shape) if not values else shape, order="F" if order == "F" else "C")


def _check_values(flat: NDArray[Any]) -> None:
    """Raises RefusedError for bytes that are no value of their type: truth beyond 0 and 1, text beyond Unicode."""
    if flat.dtype.kind == "b" and flat.view(np.uint8).max() > 1:
        raise RefusedError("truth values other than 0 and 1")
    if flat.dtype.kind == "U":
        codes = flat.view(np.dtype(np.uint32).newbyteorder(flat.dtype.byteorder))
        if codes.max() > 0x10FFFF or bool(((codes >= 0xD800) & (codes < 0xE000)).any()):
            raise RefusedError("text with characters that do not exist")
