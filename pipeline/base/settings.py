"""Settings of a library from the configuration: a frozen dataclass with some fields replaced, every name checked."""

from __future__ import annotations

import dataclasses
import difflib
import typing
import warnings
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from auglidar_base.errors import SettingsError
from pipeline.base.errors import RenamedSettingWarning, UsageError

T = TypeVar("T")


def nearest_name(name: str, known: Iterable[str]) -> str:
    """Text for a message about an unknown name: the most similar one, or all of them when none is similar."""
    names = list(known)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(names)}"


def with_changes(base: T, changes: Mapping[str, Any], where: str, others: Iterable[str] = ()) -> T:
    """`base`, a (nested) frozen dataclass, with the fields of `changes` replaced and checked against their types.

    where   dotted name of the section, put in front of messages ("augment")
    others  names that the section knows beside these fields, for the suggestion in a message
    A field that holds a dataclass takes a mapping of its own fields; a field that may be None takes null. Names of
    earlier versions, in the dataclass' RENAMED, are understood (see `renamed`).
    Raises UsageError for an unknown field (with the nearest known one), a value that does not fit, or a SettingsError
    of the dataclass; any other error in it is a fault of the program and goes through.
    """
    changes = renamed(changes, getattr(base, "RENAMED", {}), where)
    hints = typing.get_type_hints(type(base))
    fields = [field.name for field in dataclasses.fields(base) if field.init]  # type: ignore[arg-type]
    new: dict[str, Any] = {}
    for key, value in changes.items():
        if key not in fields:
            raise UsageError(f"unknown setting {where}.{key}; {nearest_name(key, [*others, *fields])}")
        new[key] = _fitting(hints[key], getattr(base, key), value, f"{where}.{key}")
    try:
        return dataclasses.replace(base, **new)  # type: ignore[type-var]
    except SettingsError as error:
        raise UsageError(f"{where}: {error}") from None


def renamed(changes: Mapping[str, Any], names: Mapping[str, str], where: str) -> dict[str, Any]:
    """`changes` with the names of today in place of those of earlier versions, with a warning for each of these.

    names  name of earlier -> name of today; "section.name" is a key of a mapping that has moved out of it
    Raises UsageError when a setting is given by both names.
    """
    found = dict(changes)
    for old, new in names.items():
        section, _, key = old.rpartition(".")
        inside = found.get(section) if section else found
        if not isinstance(inside, Mapping) or key not in inside:
            continue
        if new in found:
            raise UsageError(f"{where}.{old} is the earlier name of {where}.{new}: give one of them")
        text = f"{where}.{old} is called {where}.{new} now; the earlier name works until version 1.0"
        warnings.warn(text, RenamedSettingWarning, stacklevel=3)
        value = inside[key]
        rest = {name: other for name, other in inside.items() if name != key}
        found = {**found, section: rest} if section else rest
        found[new] = value
    return found


def _fitting(hint: Any, current: Any, value: Any, where: str) -> Any:
    """`value` as the type `hint` wants it."""
    if isinstance(value, Mapping):
        inner = _dataclass_in(hint)
        if inner is not None:
            start = current if dataclasses.is_dataclass(current) else _defaults(inner, value, where)
            return with_changes(start, value, where)
    from pydantic import ConfigDict, PydanticUserError, TypeAdapter, ValidationError

    try:
        adapter = TypeAdapter(hint, config=ConfigDict(arbitrary_types_allowed=True))
    except PydanticUserError:  # a dataclass carries its own configuration
        adapter = TypeAdapter(hint)
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        raise UsageError(f"{where}: {_first_problem(error)}, got {value!r}") from None


def _first_problem(error: Any) -> str:
    message = str(error.errors()[0]["msg"])
    return message[:1].lower() + message[1:]


def _dataclass_in(hint: Any) -> type | None:
    """The dataclass that `hint` is or allows (`X | None`)."""
    for candidate in (hint, *typing.get_args(hint)):
        if isinstance(candidate, type) and dataclasses.is_dataclass(candidate):
            return candidate
    return None


def _defaults(kind: type, value: Mapping[str, Any], where: str) -> Any:
    """A dataclass with its default values; fields without a default must be in `value`."""
    missing = dataclasses.MISSING
    required = [f.name for f in dataclasses.fields(kind) if f.default is missing and f.default_factory is missing]
    absent = [name for name in required if name not in value]
    if absent:
        raise UsageError(f"{where}: {', '.join(absent)} must be given too")
    return kind(**{name: value[name] for name in required})


def plain(settings: Any) -> Any:
    """Settings as plain dicts, lists and numbers, to be written or hashed."""
    if dataclasses.is_dataclass(settings) and not isinstance(settings, type):
        return {field.name: plain(getattr(settings, field.name)) for field in dataclasses.fields(settings)}
    if isinstance(settings, Mapping):
        return {str(key): plain(value) for key, value in settings.items()}
    if isinstance(settings, (list, tuple)):
        return [plain(value) for value in settings]
    return settings
