"""`key: numbers` lines of calibration files, in the forms that other programs write them.

Between the numbers stand blanks, commas, semicolons or brackets (printed arrays and lists); a matrix may go on over
lines that begin with a number; fractions may have a decimal comma. What a key holds is looked at when it is asked for.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError

Array = NDArray[np.float64]
_BRACKETS = str.maketrans("[](){};", "       ")
_STARTS_WITH_NUMBER = re.compile(r"\s*[\[({]*\s*[-+]?\.?\d")


@dataclass(frozen=True)
class KeyValues:
    """The lines of a file by key: line number (from 1) and the text behind the key.

    where  file named in messages
    """

    lines: dict[str, tuple[int, str]]
    where: str | Path

    def __contains__(self, key: str) -> bool:
        return key in self.lines

    def matrix(self, keys: Sequence[str], shape: tuple[int, int]) -> Array:
        """The matrix (of `shape`, or written out as 4 x 4) under the first of `keys` that the file has.

        Raises DataError when there is no such key, or its values are not that many finite numbers.
        """
        key = next((key for key in keys if key in self.lines), None)
        if key is None:
            have = ", ".join(sorted(self.lines)) or "no key at all"
            hint = "is this a calibration file of another KITTI benchmark or a label file? see docs/data.md"
            expected = f"a line '{keys[0]}:'" + (f" (or {', '.join(keys[1:])})" if keys[1:] else "")
            raise DataError(self.where, expected, have, hint)
        rows, columns = shape
        values = self._numbers(key, {rows * columns, rows * 4, 16} if rows == 3 and columns >= 3 else {rows * columns})
        if len(values) == rows * columns:
            return values.reshape(shape)
        whole = values.reshape(-1, 4)
        padded = np.eye(4)
        padded[:3, :columns] = whole[:3, :columns]
        if not np.array_equal(padded[: len(whole)], whole):
            found = "other numbers around it"
            raise DataError(self._at(key), f"{rows} x {columns} numbers, or a 4 x 4 matrix that ends in 0 0 0 1", found)
        return np.ascontiguousarray(whole[:rows, :columns])

    def _at(self, key: str) -> str:
        return f"{self.where}:{self.lines[key][0]} ({key})"

    def _numbers(self, key: str, counts: set[int]) -> Array:
        """The numbers of a line, of which there are as many as one of `counts`."""
        text = self.lines[key][1]
        readings = [reading for reading in _readings(text) if reading is not None]
        if not readings:
            words = text.translate(_BRACKETS).replace(",", " ").split()
            wrong = next((word for word in words if _number(word) is None), text.strip())
            raise DataError(self._at(key), "numbers", f"{wrong!r}")
        fitting = [values for values in readings if len(values) in counts]
        if len(fitting) != 1:
            found = f"{len(readings[0])}" if not fitting else f"{text.strip()!r}, where commas can be read in two ways"
            raise DataError(self._at(key), f"{' or '.join(map(str, sorted(counts)))} numbers", found)
        if not all(map(math.isfinite, fitting[0])):
            raise DataError(self._at(key), "finite numbers", "NaN or infinity")
        return np.array(fitting[0], dtype=np.float64)


def parse_key_values(text: str, where: str | Path) -> KeyValues:
    """KITTI's `key: numbers` lines, also `key numbers` as odometry prints them; the last line of a key counts."""
    lines: dict[str, tuple[int, str]] = {}
    key = ""
    for number, line in enumerate(text.splitlines(), start=1):
        if key and (_STARTS_WITH_NUMBER.match(line) or not line.strip(" \t[](){},;")):
            lines[key] = (lines[key][0], f"{lines[key][1]} {line}")
            continue
        words = re.split(r"\s*[:=]\s*|\s+", line.strip(), maxsplit=1)
        key = words[0]
        if key and len(words) == 2 and not key.startswith("#"):
            lines[key] = (number, words[1])
        else:
            key = ""
    return KeyValues(lines, where)


def _readings(text: str) -> list[list[float] | None]:
    """The numbers of a text with commas between them, and with commas in them where no point is; None: no numbers."""
    bare = text.translate(_BRACKETS)
    found = [_all_numbers(bare.replace(",", " "))]
    if "," in bare and "." not in bare:
        found.append(_all_numbers(bare.replace(",", ".")))
    return found


def _all_numbers(text: str) -> list[float] | None:
    numbers = [_number(word) for word in text.split()]
    return None if None in numbers else [number for number in numbers if number is not None]


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None
