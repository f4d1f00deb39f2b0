"""Text as other systems write it: byte order marks, UTF-16, and the marks between the columns of a line."""

from __future__ import annotations

import codecs
import re

# UTF-32's mark begins with UTF-16's: it is looked for first. Source: The Unicode Standard, section 23.8.
_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32-le"),
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")


def decode_text(data: bytes) -> str:
    """The text of a file: UTF-8, or what its byte order mark says, or UTF-16 without a mark; no marks are left in it.

    Raises ValueError for bytes that are no text.
    """
    encoding = next((name for mark, name in _MARKS if data.startswith(mark)), None) or _unmarked(data)
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        found = f"byte 0x{data[error.start]:02x} at offset {error.start}"
        raise ValueError(f"bytes that are not {encoding.upper()} text ({found})") from None
    if "\0" in text:
        raise ValueError(f"binary data (a zero byte at offset {text.index(chr(0))})")
    # Marks stand inside when files were joined; Ctrl-Z ends files of old DOS editors.
    return text.replace("\ufeff", "").rstrip("\x1a")


def _unmarked(data: bytes) -> str:
    """Western text in UTF-16 has a zero in every other byte; nothing else of this kind has a zero at all."""
    if len(data) > 1 and len(data) % 2 == 0:
        if not any(data[1::2]) and all(data[0::2]):
            return "utf-16-le"
        if not any(data[0::2]) and all(data[1::2]):
            return "utf-16-be"
    return "utf-8"


def split_fields(line: str, fewest: int) -> list[str]:
    """The columns of a label or result line of at least `fewest` columns: parted by blanks, or by , or ; as in a table.

    A comma inside every fraction of a line without a single point is a decimal comma. What is not clear stays as it is,
    so that reading its numbers names it.
    """
    fields = line.split()
    if "," not in line and ";" not in line:
        return fields
    if ";" in line:
        fields = line.replace(";", " ").split()
    if len(fields) < fewest:
        return line.replace(",", " ").replace(";", " ").split()
    if not any("." in field for field in fields[1:]):
        return [fields[0], *(f.replace(",", ".") if _DECIMAL_COMMA.fullmatch(f) else f for f in fields[1:])]
    return [field[:-1] if field.endswith(",") else field for field in fields]
