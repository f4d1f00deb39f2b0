"""Pickles whose dtypes and arrays lie. Python's unpickler with NumPy's names let in dies of five of them (SIGSEGV)."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np

_reconstruct = np.arange(2).__reduce__()[0]
_scalar = np.float32(1).__reduce__()[0]
_F8 = np.dtype("f8")


class Made:
    """Pickled as a call of `function` and, when there is one, a state for what it returns."""

    def __init__(self, function: Callable[..., Any], arguments: tuple[Any, ...], *state: Any) -> None:
        self.parts = (function, arguments, *state)

    def __reduce__(self) -> Any:
        return self.parts


def dtype(name: str, *state: Any) -> Made:
    """A dtype with a state of the file's choice."""
    return Made(np.dtype, (name, False, True), *state)


def array(kind: Any, data: object, shape: object = (4,)) -> Made:
    """An array whose state the file chooses."""
    return Made(_reconstruct, (np.ndarray, (0,), b"b"), (1, shape, kind, False, data))


def flags(name: str, value: int) -> Made:
    """A dtype with flags of the file's choice."""
    return dtype(name, (3, "<", None, None, None, -1, -1, value))


_FIELDS = (3, "|", None, ("a",), {"a": (np.dtype("O"), 1 << 30)}, 8, 1, 16)
_OVERLAPPING = (3, "|", None, ("a", "b"), {"a": (np.dtype("O"), 0), "b": (_F8, 0)}, 8, 1, 16)
_SUBARRAY = (3, "<", (np.dtype("O"), (1 << 20,)), None, None, 8, 8, 0)
_POINTERS = b"\x41" * 32

FORGED: dict[str, Made] = {
    "numbers flagged as objects": array(flags("f8", 63), _POINTERS),
    "numbers flagged as objects, no array": array(flags("f8", 1), [1, 2, 3, 4]),
    "a field far outside the item": array(dtype("V8", _FIELDS), _POINTERS),
    "objects over numbers": array(dtype("V8", _OVERLAPPING), _POINTERS),
    "a subarray of objects": array(dtype("V8", _SUBARRAY), _POINTERS),
    "text of another size": array(dtype("U4", (3, "<", None, None, None, 1 << 20, 4, 8)), _POINTERS * 2),
    "bytes of a huge size": array(dtype("S8", (3, "|", None, None, None, (1 << 31) - 1, 1, 0)), _POINTERS),
    "a state inside the state": array(flags("f8", 8), _POINTERS),
    "objects without their flags": array(dtype("O8", (3, "|", None, None, None, -1, -1, 0)), _POINTERS),
    "objects from bytes": array(np.dtype("O"), _POINTERS),
    "too few objects": array(np.dtype("O"), [None]),
    "too few bytes": array(_F8, b"1234567"),
    "too many bytes": array(_F8, b"1" * 33),
    "a negative length": array(_F8, _POINTERS, (-4,)),
    "lengths whose product wraps around": array(_F8, b"", (1 << 32, 1 << 32)),
    "a row without end": array(_F8, b"", (1 << 62, 0)),
    "an older state": Made(_reconstruct, (np.ndarray, (0,), b"b"), ((4,), _F8, False, _POINTERS)),
    "another class": Made(_reconstruct, (np.matrix, (0,), b"b"), (1, (2, 2), _F8, False, _POINTERS)),
    "a huge array announced": Made(_reconstruct, (np.ndarray, (1 << 40,), b"O")),
    "an array called with strides": Made(np.ndarray, ((4,), _F8, b"1" * 32, 0, (1 << 40,))),
    "a scalar of objects": Made(_scalar, (np.dtype("O"), b"A" * 8)),
    "a scalar of a forged type": Made(_scalar, (flags("f8", 63), b"A" * 8)),
    "a short scalar": Made(_scalar, (_F8, b"A")),
}


def forged(name: str) -> bytes:
    """The pickle of this name."""
    return pickle.dumps([{"name": FORGED[name]}], protocol=4)
