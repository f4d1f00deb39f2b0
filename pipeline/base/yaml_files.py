"""YAML that people write: plain values only, every key once, and bounded, so that a file ends in a tree or one line."""

from __future__ import annotations

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from pipeline.base.errors import UsageError

MAX_BYTES = 1_000_000
# Values of a file with its aliases written out. configs/reference.yaml has about 300.
MAX_VALUES = 20_000
# Whole numbers are seeds, counts and sizes; what NumPy holds in 64 bits is enough for them.
MAX_DIGITS = 18


def read_yaml(path: Path) -> dict[str, Any]:
    """The keys and values of a file; {} for an empty one. Raises UsageError, one line that names the file."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise UsageError(f"{path}: expected a configuration file, got {path.stat().st_size / 1e6:.1f} MB")
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: not valid YAML: {error}") from None
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
    tree = parse_yaml(text, str(path))
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise UsageError(f"{path}: expected 'section:' lines, got {type(tree).__name__}")
    return tree


def parse_yaml(text: str, where: str) -> Any:
    """The value of a YAML text. `where` names it in the message of the UsageError for text that is none."""
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _count_values(node, {})
        return loader.construct_document(node)
    except _RefusedError as error:
        raise UsageError(f"{where}: {error}") from None
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise UsageError(f"{where}: not valid YAML: {' '.join(str(error).split())}") from None


class _RefusedError(Exception):
    """Valid YAML that no configuration needs."""


class _Loader(yaml.SafeLoader):
    """Plain values only; a key that stands twice and a number beyond 64 bits are refused with their lines."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Before the keys of `<<` are mixed in, which a mapping may replace."""
        lines: dict[Hashable, int] = {}
        for key_node, _ in node.value:
            merge = key_node.tag == "tag:yaml.org,2002:merge"
            key = "<<" if merge else self.construct_object(key_node, deep=True)
            line = key_node.start_mark.line + 1
            if not isinstance(key, str):
                raise _RefusedError(f"line {line}: expected a name as key, got {key!r} (put it in quotes)")
            if key in lines:
                raise _RefusedError(f"key {key!r} stands twice, in line {lines[key]} and line {line}; remove one")
            lines[key] = line
        super().flatten_mapping(node)

    def construct_whole_number(self, node: yaml.ScalarNode) -> int:
        """A number of at most 18 digits."""
        if len(node.value.strip("+-").replace("_", "")) > MAX_DIGITS + 2:
            raise _RefusedError(f"line {node.start_mark.line + 1}: a whole number of {len(node.value)} digits")
        number = int(self.construct_yaml_int(node))
        if abs(number) >= 10**MAX_DIGITS:
            raise _RefusedError(f"line {node.start_mark.line + 1}: the number {number} is too large")
        return number


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_whole_number)


def _count_values(node: yaml.Node, known: dict[int, int | None]) -> int:
    """Values below a node with aliases written out. Refuses too many, and an alias within what it stands for."""
    if id(node) in known:
        count = known[id(node)]
        if count is None:
            raise _RefusedError(f"line {node.start_mark.line + 1}: an alias stands inside what it names")
        return count
    known[id(node)] = None
    parts: list[yaml.Node] = []
    if isinstance(node, yaml.MappingNode):
        parts = [part for pair in node.value for part in pair]
    elif isinstance(node, yaml.SequenceNode):
        parts = node.value
    count = 1 + sum(_count_values(part, known) for part in parts)
    if count > MAX_VALUES:
        raise _RefusedError(f"line {node.start_mark.line + 1}: more than {MAX_VALUES} values with aliases written out")
    known[id(node)] = count
    return count
