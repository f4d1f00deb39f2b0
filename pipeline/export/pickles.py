"""Pickle files that OpenPCDet and mmdetection3d read as their info lists, written item by item. Writing only.

A list of 7481 dicts is never held in memory: each item is pickled by itself and its opcodes are put into the list's.
That is sound in protocol 3, whose memo indices are explicit: an item refers to indices that it has written itself.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable
from typing import Any, BinaryIO

_PROTOCOL = 3
_HEADER = pickle.PROTO + bytes([_PROTOCOL])
# NumPy 2 names the module that rebuilds arrays `numpy._core`; readers with NumPy below 1.26 know `numpy.core` only, and
# newer ones know both. The name stands in a GLOBAL opcode that ends with a newline, so its length may change.
_NEW_NAMES = (
    (b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n"),
    (b"cnumpy._core.numeric\n", b"cnumpy.core.numeric\n"),
)


def item_opcodes(value: Any) -> bytes:
    """The opcodes that push `value` on the unpickler's stack, without header and stop."""
    data = pickle.dumps(value, protocol=_PROTOCOL)[len(_HEADER) : -1]
    for new, old in _NEW_NAMES:
        data = data.replace(new, old)
    return data


def write_list(file: BinaryIO, items: Iterable[bytes]) -> None:
    """A pickled list of items given as `item_opcodes`."""
    file.write(_HEADER)
    _push_list(file, items)
    file.write(pickle.STOP)


def write_dict_of_lists(file: BinaryIO, fixed: dict[str, Any], lists: Iterable[tuple[str, Iterable[bytes]]]) -> None:
    """A pickled dict: the entries of `fixed`, then name -> list of items given as `item_opcodes`."""
    file.write(_HEADER + pickle.EMPTY_DICT)
    for name, value in fixed.items():
        file.write(item_opcodes(name) + item_opcodes(value) + pickle.SETITEM)
    for name, items in lists:
        file.write(item_opcodes(name))
        _push_list(file, items)
        file.write(pickle.SETITEM)
    file.write(pickle.STOP)


def _push_list(file: BinaryIO, items: Iterable[bytes]) -> None:
    file.write(pickle.EMPTY_LIST)
    for item in items:
        file.write(item)
        file.write(pickle.APPEND)
