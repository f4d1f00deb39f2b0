"""What the fields of a settings dataclass mean: read from the list in its docstring, the one place that says it."""

from __future__ import annotations

import dataclasses
import re
import typing
from typing import Any

INDENT = 4


def meanings(kind: type) -> dict[str, str]:
    """Field -> its meaning, from lines "name  meaning" or "name, other  meaning"; several pairs may share a line.

    A line that is indented further continues the meaning above it. Other text is passed over. What a dataclass takes
    over from another has its meaning there.
    """
    names = "|".join(sorted((re.escape(field.name) for field in dataclasses.fields(kind)), key=len, reverse=True))
    entry = re.compile(rf"(?:^|\s{{2,}})((?:{names})(?:, (?:{names}))*)\s{{2,}}")
    found: dict[str, str] = {}
    for base in kind.__bases__:
        found |= meanings(base) if dataclasses.is_dataclass(base) else {}
    current: tuple[str, ...] = ()
    for line in (kind.__doc__ or "").splitlines()[1:]:
        text = line.strip()
        deeper = len(line) - len(line.lstrip()) > INDENT
        pieces = entry.split(text)
        # Before the first name stands what continues the line above, when it is indented like that.
        if deeper and pieces[0]:
            found |= {name: f"{found[name]} {pieces[0]}" for name in current}
        elif pieces[0] or not text:
            current = ()
        for listed, meaning in zip(pieces[1::2], pieces[2::2]):
            current = tuple(listed.split(", "))
            found |= dict.fromkeys(current, meaning)
    return found


def nested_settings(hint: Any) -> Any:
    """The dataclass of a hint `X | None` with its defaults; None when there is none or it has fields without one."""
    for kind in typing.get_args(hint):
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            try:
                return kind()
            except TypeError:
                return None
    return None
