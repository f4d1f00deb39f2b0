"""Everything is in pyproject.toml but this: the modules are those of the repository, collected when a build begins.

Module X of the repository becomes `auglidar_eval.X`, and its imports of others follow; nothing else of it changes. So
this distribution and `auglidar` own no file of the same name and can be installed together.
"""

from __future__ import annotations

import ast
import re
import shutil
from pathlib import Path

from setuptools import setup

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parent.parent
TARGET = HERE / "src" / "auglidar_eval"
ROOMS = ("auglidar_base", "detection", "pipeline")
# What the command line of the evaluator imports, late imports included (tests/test_auglidar_eval.py).
MODULES = (
    "auglidar_base/atomic.py",
    "auglidar_base/errors.py",
    "detection/evaluation/*.py",
    "detection/kitti_format.py",
    "detection/ops/_numba.py",
    "detection/ops/_rotated_iou_torch.py",
    "detection/ops/_rounding.py",
    "detection/ops/rotated_iou.py",
    "detection/text.py",
    "detection/types.py",
    "pipeline/base/meanings.py",
    "pipeline/verbs/evaluate.py",
)


def collect() -> None:
    """Writes the modules below `auglidar_eval`, and the licence beside this file."""
    for room in ROOMS:
        shutil.rmtree(TARGET / room, ignore_errors=True)
    for source in (path for pattern in MODULES for path in sorted(REPOSITORY.glob(pattern))):
        module = source.relative_to(REPOSITORY)
        write(TARGET / module, inside(source.read_text(encoding="utf-8")))
        for package in list(module.parents)[:-1]:
            write(TARGET / package / "__init__.py", docstring_of(REPOSITORY / package / "__init__.py"))
    shutil.copy(REPOSITORY / "LICENSE", HERE)


def inside(source: str) -> str:
    """The source with absolute imports of the repository's modules pointing below `auglidar_eval`."""
    return re.sub(rf"(?m)^(\s*from )(?=(?:{'|'.join(ROOMS)})\b)", r"\1auglidar_eval.", source)


def docstring_of(package: Path) -> str:
    """What a package says of itself; the names it hands out may belong to modules that are not collected."""
    text = ast.get_docstring(ast.parse(package.read_text(encoding="utf-8")))
    return f'"""{text}\n"""\n'


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


# An sdist holds the collected modules already, wherever it is unpacked.
if not (HERE / "PKG-INFO").exists():
    collect()
setup()
