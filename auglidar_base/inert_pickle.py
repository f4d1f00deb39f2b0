"""Pickles of other projects, read without running what they ask for: containers, texts, numbers and arrays only.

Python's unpickler hands classes and their states to a file; NumPy believes such states. This one is a small machine of
its own over the opcodes that `pickletools` tells apart: it knows a few names, which stand for code in `inert_arrays`,
and nothing of Python or NumPy can be called from a file. Memory and nesting are bounded.
"""

from __future__ import annotations

import pickletools
import struct
import warnings
from collections.abc import Iterable
from typing import Any

import numpy as np

from auglidar_base.inert_arrays import RefusedError, StatedDtype, stated_array, stated_scalar

__all__ = ["RefusedError", "loads"]

# KITTI's infos have four million opcodes and less than a million containers, which take the most memory.
MOST_OPCODES = 20_000_000
MOST_CONTAINERS = 3_000_000
DEEPEST = 50
_KEYS = (str, bytes, int, float, type(None), np.generic)
_CODECS = ("latin1", "latin-1", "ascii", "utf-8", "utf8")
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_EMPTY = {"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_SET": set, "EMPTY_TUPLE": tuple}
_VALUES = {"INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"}
_VALUES |= {"STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"}
_VALUES |= {"BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_FROM_MARK = {"LIST", "TUPLE", "DICT", "FROZENSET", "APPENDS", "SETITEMS", "ADDITEMS", "POP_MARK"}
_NAMES = {"numpy.ndarray": "ndarray", "numpy.dtype": "dtype", "_codecs.encode": "encode"}
_NAMES |= {"builtins.bytes": "bytes", "__builtin__.bytes": "bytes"}
for _package in ("numpy.core", "numpy._core"):
    _NAMES[f"{_package}.multiarray._reconstruct"] = "reconstruct"
    _NAMES[f"{_package}.multiarray.scalar"] = "scalar"
    _NAMES[f"{_package}.numeric._frombuffer"] = "frombuffer"


def loads(data: bytes) -> Any:
    """The contents of a pickle of any protocol. Raises RefusedError, saying why, when it holds anything but data."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of odd escapes in the texts of a damaged file
            value = _Machine(len(data)).run(data)
            _check_contents(value, 16 * len(data) + 1_000_000)
        return value
    except RefusedError:
        raise
    except MemoryError:
        raise RefusedError("it asks for more memory than there is") from None
    except IndexError:
        raise RefusedError("its end comes too early, or values are missing") from None
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError, struct.error) as error:
        raise RefusedError(" ".join(str(error).split())[:200] or "damage") from None


class _Name:
    """A name that the file mentions and this reader knows."""

    def __init__(self, module: Any, attribute: Any) -> None:
        if type(module) is not str or type(attribute) is not str:
            raise RefusedError("it asks for a name that is no text")
        full_name = f"{module}.{attribute}"
        if full_name not in _NAMES:
            raise RefusedError(f"it asks for {full_name[:100]}, which no data file needs")
        self.name = _NAMES[full_name]


class _PendingArray:
    """An array that was announced; its contents follow. `places` are those of the memo that must hold it then."""

    def __init__(self) -> None:
        self.places: list[int] = []


class _Machine:
    """The stack and memo of one file."""

    def __init__(self, length: int) -> None:
        """length  of the file in bytes: arrays may hold a little more than that, however often they are stated"""
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}
        self.bytes_left = 2 * length + 1_000_000
        self.containers_left = MOST_CONTAINERS

    def run(self, data: bytes) -> Any:
        """Works through the opcodes and returns what is on the stack at the end."""
        for count, (opcode, argument, _) in enumerate(pickletools.genops(data)):
            if count > MOST_OPCODES:
                raise RefusedError(f"it has more than {MOST_OPCODES:,} opcodes")
            self.step(opcode.name, argument)
        return self.pop()

    def step(self, name: str, argument: Any) -> None:
        """One opcode."""
        if name in _VALUES:
            self.stack.append(_value(argument))
        elif name in _CONSTANTS:
            self.stack.append(_CONSTANTS[name])
        elif name in _EMPTY:
            self.add(_EMPTY[name]())
        elif name in _TUPLES:
            self.add(tuple(self.pop_many(_TUPLES[name])))
        elif name in _FROM_MARK:
            self.gather(name, self.pop_mark())
        elif name in ("PUT", "BINPUT", "LONG_BINPUT"):
            self.keep(argument)
        elif name == "MEMOIZE":
            self.keep(len(self.memo))
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            self.stack.append(self.recall(argument))
        elif name not in ("PROTO", "FRAME", "STOP"):
            self.rarer(name, argument)

    def rarer(self, name: str, argument: Any) -> None:
        """The opcodes that work on single values."""
        if name == "MARK":
            self.marks.append(len(self.stack))
        elif name == "APPEND":
            self.gather("APPENDS", self.pop_many(1))
        elif name == "SETITEM":
            self.gather("SETITEMS", self.pop_many(2))
        elif name == "REDUCE":
            function, arguments = self.pop_many(2)
            self.stack.append(self.call(function, arguments))
        elif name == "BUILD":
            self.build(self.pop())
        elif name == "GLOBAL":
            self.stack.append(_Name(*argument.split(" ", 1)))
        elif name == "STACK_GLOBAL":
            self.stack.append(_Name(*self.pop_many(2)))
        elif name == "POP":
            self.pop()
        elif name == "DUP":
            self.stack.append(self.top())
        else:
            raise RefusedError(f"it asks for {name}, which no data file needs")

    def floor(self) -> int:
        """What lies below the last mark is out of reach."""
        return self.marks[-1] if self.marks else 0

    def top(self) -> Any:
        if len(self.stack) <= self.floor():
            raise IndexError
        return self.stack[-1]

    def pop(self) -> Any:
        self.top()
        return self.stack.pop()

    def pop_many(self, count: int) -> list[Any]:
        """The last `count` values, oldest first."""
        if len(self.stack) - count < self.floor():
            raise IndexError
        found = self.stack[-count:]
        del self.stack[-count:]
        return found

    def pop_mark(self) -> list[Any]:
        """The values above the last mark, which goes."""
        start = self.marks.pop()
        found = self.stack[start:]
        del self.stack[start:]
        return found

    def add(self, container: Any) -> None:
        """Puts a new container on the stack."""
        self.containers_left -= 1
        if self.containers_left < 0:
            raise RefusedError(f"it has more than {MOST_CONTAINERS:,} containers")
        self.stack.append(container)

    def gather(self, name: str, items: list[Any]) -> None:
        """Puts items into a new container or into the one on the stack."""
        if name in ("LIST", "TUPLE"):
            self.add(items if name == "LIST" else tuple(items))
        elif name == "FROZENSET":
            self.add(frozenset(_keys(items)))
        elif name == "DICT":
            self.add(_pairs(items))
        elif name == "APPENDS":
            _of_type(self.top(), list).extend(items)
        elif name == "SETITEMS":
            _of_type(self.top(), dict).update(_pairs(items))
        elif name == "ADDITEMS":
            _of_type(self.top(), set).update(_keys(items))

    def keep(self, place: int) -> None:
        """Notes the value on the stack; the memo is a dict, so a huge place takes no memory."""
        value = self.memo[place] = self.top()
        if isinstance(value, _PendingArray):
            value.places.append(place)

    def recall(self, place: int) -> Any:
        if place not in self.memo:
            raise RefusedError(f"it refers to value {place}, which it did not store")
        return self.memo[place]

    def call(self, function: Any, arguments: Any) -> Any:
        """What a known name stands for, with arguments from the file."""
        if not isinstance(function, _Name) or type(arguments) is not tuple:
            raise RefusedError("it calls something that is no function")
        self.spend(arguments)
        if function.name == "dtype":
            return StatedDtype(arguments)
        if function.name == "scalar":
            return stated_scalar(arguments)
        if function.name == "encode":
            return _encoded(*arguments)
        if function.name == "bytes" and not arguments:
            return b""
        if function.name == "frombuffer" and len(arguments) == 4:
            data, dtype, shape, order = arguments
            return stated_array(shape, dtype, data, order if type(order) is str else "C")
        if function.name == "reconstruct" and len(arguments) == 3 and _is_ndarray(arguments[0]):
            return _PendingArray()
        raise RefusedError(f"it calls {function.name} in an unusual way")

    def build(self, state: Any) -> None:
        """Gives the value on the stack its state: the byte order of a dtype, the contents of an array."""
        target = self.top()
        if isinstance(target, StatedDtype):
            target.set_state(state)
            return
        if not (isinstance(target, _PendingArray) and type(state) is tuple and len(state) == 5):
            raise RefusedError("it sets the state of something that is no array")
        _, shape, dtype, columns_first, data = state
        self.spend((data,))
        order = "F" if type(columns_first) in (bool, int) and columns_first else "C"
        array = self.stack[-1] = stated_array(shape, dtype, data, order)
        for place in target.places:
            if self.memo[place] is target:
                self.memo[place] = array

    def spend(self, parts: tuple[Any, ...]) -> None:
        """Counts the bytes that are copied: the same bytes may be stated a thousand times."""
        self.bytes_left -= sum(len(part) for part in parts if isinstance(part, (bytes, bytearray, str, list)))
        if self.bytes_left < 0:
            raise RefusedError("its arrays would take more memory than the file accounts for")


def _value(argument: Any) -> Any:
    """A number or text of the file; numbers of 64 bits and text that can be written."""
    if type(argument) is int and not -(2**63) <= argument < 2**64:
        raise RefusedError("an integer of more than 64 bits")
    if type(argument) is str:
        argument.encode("utf-8")
    return argument


def _encoded(text: Any = None, encoding: Any = "latin1") -> bytes:
    """Protocol 2 and older spell bytes as text that is encoded again."""
    if type(text) is not str or type(encoding) is not str or encoding not in _CODECS:
        raise RefusedError("it asks for an encoding that no data file needs")
    return text.encode(encoding)


def _is_ndarray(value: Any) -> bool:
    return isinstance(value, _Name) and value.name == "ndarray"


def _of_type(value: Any, kind: Any) -> Any:
    if type(value) is not kind:
        raise RefusedError(f"it adds to something that is no {kind.__name__}")
    return value


def _keys(items: Iterable[Any]) -> list[Any]:
    """Keys of dicts and sets: single values only, since hashing nested ones takes as much stack as the file says."""
    found = list(items)
    for key in found:
        if not isinstance(key, _KEYS):
            raise RefusedError(f"a {type(key).__name__} as a key")
    return found


def _pairs(items: list[Any]) -> dict[Any, Any]:
    if len(items) % 2:
        raise RefusedError("a key without a value")
    return dict(zip(_keys(items[::2]), items[1::2]))


def _children(value: Any) -> list[Any]:
    """What a container holds. Raises RefusedError for a value that is no data."""
    if type(value) in (list, tuple):
        return list(value)
    if type(value) is dict:
        return list(value.values())
    if isinstance(value, np.ndarray):
        return list(value.flat) if value.dtype.hasobject else []
    if isinstance(value, (*_KEYS, bytearray, set, frozenset)):
        return []
    raise RefusedError("it holds a name or a half-made array in the place of data")


def _check_contents(value: Any, most: int) -> None:
    """Raises RefusedError unless `value` is data, nested `DEEPEST` deep at most, with `most` values when written out.

    A list that holds one list twice, and so on forty times, is small in memory and endless to whoever walks through it.
    """
    if _written_out(value, 1, {})[0] > most:
        raise RefusedError("it refers to the same values again and again")


def _written_out(value: Any, depth: int, known: dict[int, tuple[int, int]]) -> tuple[int, int]:
    """(number of values, levels) below and with `value`, which lies `depth` levels down."""
    children = _children(value)
    if not children:
        return 1, 1
    if id(value) not in known:
        if depth >= DEEPEST:
            raise RefusedError(f"it is nested more than {DEEPEST} levels deep, or holds itself")
        found = [_written_out(child, depth + 1, known) for child in children]
        known[id(value)] = 1 + sum(size for size, _ in found), 1 + max(height for _, height in found)
    size, height = known[id(value)]
    if depth + height > DEEPEST + 1:
        raise RefusedError(f"it is nested more than {DEEPEST} levels deep")
    return size, height
