"""The one-way rules: between the leaf and the three rooms, and from the ground floor of `pipeline` to its roof."""

from __future__ import annotations

import ast
from collections.abc import Collection, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FORBIDDEN = {
    "auglidar_base": {"completion", "detection", "pipeline", "yaml", "pydantic", "rich", "cv2", "numba", "scipy"},
    "completion": {"detection", "pipeline", "yaml", "pydantic", "rich"},
    "detection": {"completion", "pipeline", "yaml", "pydantic", "rich"},
    "pipeline": set(),
}
# The rooms of `pipeline` from the ground up: each imports rooms of lower floors, or of its own floor without a circle.
FLOORS: tuple[tuple[str, ...], ...] = (
    ("base",),
    ("geometry",),
    ("data",),
    ("simulation", "pointcloud", "semantics"),
    ("run_folder",),
    ("stages",),
    ("runner",),
    ("synthetic", "report", "export", "check", "scoring", "training"),
    ("experiments", "benchmark", "pretrained"),
    ("summary", "reference", "run", "cli", "verbs"),
)
# Reproduction and measuring: the way in is a verb, no stage of a run needs them.
REACHED_FROM_VERBS_ONLY = {"experiments", "benchmark", "pretrained"}


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


def modules() -> dict[str, Path]:
    """Dotted name -> file, of the packages."""
    found = {}
    for package in FORBIDDEN:
        for file in (ROOT / package).rglob("*.py"):
            parts = file.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


def imported_modules(file: Path, known: Collection[str]) -> set[str]:
    """The known modules that a file imports wherever the import stands: at the top, in a function, for types only."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
            if any(f"{node.module}.{alias.name}" not in known for alias in node.names):
                found.add(node.module)
    return found & set(known)


def circles(graph: Mapping[str, Collection[str]]) -> list[str]:
    """Nodes that reach themselves: what is left when those without arrows are taken away again and again."""
    left = {node: set(targets) for node, targets in graph.items()}
    while ends := {node for node, targets in left.items() if not targets & left.keys()}:
        left = {node: targets for node, targets in left.items() if node not in ends}
    while starts := left.keys() - {target for targets in left.values() for target in targets}:
        left = {node: targets for node, targets in left.items() if node not in starts}
    return sorted(left)


def room_of(module: str) -> str | None:
    """The room of a module of `pipeline`; None for the package itself."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else None


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    known = modules()
    return {name: imported_modules(file, known) - {name} for name, file in known.items()}


def test_circles_are_found() -> None:
    assert circles({"a": ["b"], "b": ["c"], "c": ["b"], "d": ["a"]}) == ["b", "c"]
    assert circles({"a": ["b"], "b": ["c"], "c": []}) == []


def test_no_files_import_each_other(imports: dict[str, set[str]]) -> None:
    # A package that hands out names of its modules is no circle with them.
    assert (
        circles({name: {t for t in targets if not name.startswith(f"{t}.")} for name, targets in imports.items()}) == []
    )


def test_rooms_of_pipeline_stand_on_the_floors_below(imports: dict[str, set[str]]) -> None:
    floor = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
    between: dict[str, set[str]] = {room: set() for room in floor}
    wrong = []
    for module, targets in imports.items():
        if not module.startswith("pipeline."):
            continue
        room = str(room_of(module))
        for target in targets:
            other = room_of(target) if target.startswith("pipeline.") else None
            if other is None or other == room:
                continue
            between[room].add(other)
            if floor[other] > floor[room] or (other in REACHED_FROM_VERBS_ONLY and room not in FLOORS[-2] + ("verbs",)):
                wrong.append(f"{module} imports {target}")
    assert sorted(wrong) == []
    assert circles(between) == []
