"""A completion method or a detector of one's own: `package.module:Class`, or an entry point, in place of weights.

Such a class is made with the section's `options` as keyword arguments and has one method:

    completer   complete(sparse, image, K=None) -> CompletedDepth, or an (H, W) depth map in metres
    detector    detect(frame: PointFrame) -> Detections

Modules are found as Python finds them, and in the current folder after that.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import inspect
import json
import re
import sys
from collections.abc import Mapping
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from pipeline.base.errors import UsageError

Room = Literal["completion", "detection"]
# Entry points of installed packages: a short name for package.module:Class.
GROUPS: Mapping[Room, str] = {"completion": "auglidar.completers", "detection": "auglidar.detectors"}
# The method of a class, and how many values it is called with.
METHODS: Mapping[Room, tuple[str, int]] = {"completion": ("complete", 3), "detection": ("detect", 1)}
_REFERENCE = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")


def is_own(room: Room, name: str) -> bool:
    """Whether `name` means a class: module:Class, or an entry point of the room's group."""
    return _REFERENCE.fullmatch(name) is not None or name in _entry_points(GROUPS[room])


@lru_cache(maxsize=2)
def _entry_points(group: str) -> dict[str, str]:
    return {point.name: point.value for point in metadata.entry_points(group=group)}


def own_class(room: Room, name: str, options: Mapping[str, Any]) -> type:
    """The class, looked over before anything is computed.

    Raises UsageError in one line: no such module or class, no such method, options that it does not take.
    """
    key, (method, count) = f"{room}.model={name}", METHODS[room]
    module_name, _, class_name = _entry_points(GROUPS[room]).get(name, name).partition(":")
    module = _module(key, module_name)
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        raise UsageError(f"{key}: {module.__file__} has no class {class_name!r}")
    function = getattr(found, method, None)
    if not callable(function) or not _takes(function, (None,) * (1 + count), {}):
        form = "complete(self, sparse, image, K=None)" if room == "completion" else "detect(self, frame)"
        raise UsageError(f"{key}: expected a class with the method {form}, {module.__file__} has none in {class_name}")
    if not _takes(found, (), options):
        given = ", ".join(options) or "none"
        raise UsageError(f"{key}: {class_name}{inspect.signature(found)} does not take these {room}.options: {given}")
    return found


def _module(key: str, name: str) -> Any:
    here = str(Path.cwd())
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)
    try:
        return importlib.import_module(name)
    except Exception as error:
        # A user's module may fail in any way while it is imported.
        why = f"{type(error).__name__}: {error}"
        raise UsageError(f"{key}: {name} cannot be imported from {here} or the environment: {why}") from None


def _takes(function: Any, positional: tuple[Any, ...], named: Mapping[str, Any]) -> bool:
    try:
        inspect.signature(function).bind(*positional, **named)
    except TypeError:
        return False
    return True


def own_files(room: Room, name: str, options: Mapping[str, Any]) -> tuple[Path, ...]:
    """What a result depends on: the source of the class, and every file that an option names.

    Of a package all its Python files; of a single module, itself and the modules beside it that it imports.
    """
    module = sys.modules[own_class(room, name, options).__module__]
    top = sys.modules[module.__name__.partition(".")[0]]
    if hasattr(top, "__path__"):
        source = sorted(path for folder in top.__path__ for path in Path(folder).rglob("*.py"))
    else:
        source = sorted(_with_neighbours(Path(str(module.__file__)), set()))
    named = (Path(value) for value in options.values() if isinstance(value, str))
    return *source, *(path for path in named if path.is_file())


def own_version(room: Room, name: str, options: Mapping[str, Any]) -> str:
    """Twelve hex digits of name, options and the contents of `own_files`."""
    digest = hashlib.sha256(json.dumps([name, options], sort_keys=True).encode())
    for path in own_files(room, name, options):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def _with_neighbours(path: Path, seen: set[Path]) -> set[Path]:
    """`path` and what it imports from its own folder, and what that imports."""
    if path in seen or not path.is_file():
        return seen
    seen.add(path)
    for node in ast.walk(ast.parse(path.read_bytes())):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
        for name in names:
            beside = path.parent / name.partition(".")[0]
            for file in sorted(beside.rglob("*.py")) if beside.is_dir() else [beside.with_suffix(".py")]:
                _with_neighbours(file, seen)
    return seen


def made(room: Room, name: str, options: Mapping[str, Any]) -> Any:
    """The object of the class. UsageError when its construction fails."""
    found = own_class(room, name, options)
    try:
        return found(**options)
    except Exception as error:
        raise UsageError(f"{room}.model={name}: it cannot be made: {type(error).__name__}: {error}") from error
