"""The one-way rule: `pipeline` imports `completion` and `detection`; these two import neither it nor each other."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FORBIDDEN = {
    "completion": {"detection", "pipeline", "yaml", "pydantic", "rich"},
    "detection": {"completion", "pipeline", "yaml", "pydantic", "rich"},
    "pipeline": set(),
}


def imported_packages(source: Path) -> dict[str, int]:
    """Top-level package name -> line, for every import of a file wherever it stands."""
    found: dict[str, int] = {}
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update({alias.name.split(".")[0]: node.lineno for alias in node.names})
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found[node.module.split(".")[0]] = node.lineno
    return found


@pytest.mark.parametrize("room", sorted(FORBIDDEN))
def test_rooms_import_in_one_direction(room: str) -> None:
    files = sorted((ROOT / room).rglob("*.py"))
    assert files, f"no source files under {room}/"
    wrong = [
        f"{file.relative_to(ROOT)}:{line} imports {package}"
        for file in files
        for package, line in imported_packages(file).items()
        if package in FORBIDDEN[room]
    ]
    assert wrong == []


def test_nothing_ships_test_code() -> None:
    wrong = [
        f"{file.relative_to(ROOT)}:{line}"
        for room in FORBIDDEN
        for file in (ROOT / room).rglob("*.py")
        for package, line in imported_packages(file).items()
        if package in {"tests", "pytest", "hypothesis"}
    ]
    assert wrong == []
