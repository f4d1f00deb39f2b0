"""The distribution auglidar-eval: its sdist, the wheel made from it, and an environment with NumPy and Numba alone."""

from __future__ import annotations

import ast
import json
import re
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from detection.kitti_format import KittiObject, format_line
from tests.doc_commands import blocks
from tests.test_packaging import ROOT, call, copy_of_checkout, install, wheel_from_sdist

PAGE = ROOT / "docs" / "auglidar-eval.md"
BORROWED = ("numpy", "numpy.libs", "numba", "llvmlite")
# Compiling every kernel takes 20 s; the results of the interpreter are the same numbers.
NOT_COMPILED = {"NUMBA_DISABLE_JIT": "1"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    checkout = copy_of_checkout(folder / "checkout")
    kept = shutil.ignore_patterns("auglidar_base", "detection", "pipeline", "LICENSE", "build", "*.egg-info")
    shutil.copytree(ROOT / "packages", checkout / "packages", ignore=kept)
    return wheel_from_sdist(checkout / "packages" / "auglidar-eval", folder)


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install(wheel, tmp_path_factory.mktemp("environment"), BORROWED)


@pytest.fixture
def desk(tmp_path: Path) -> Path:
    """Two frames of KITTI, and results: the second car is found 0.2 m too far away, and a third that is not there."""
    labels, results = tmp_path / "KITTI" / "training" / "label_2", tmp_path / "RESULTS"
    for number in range(2):
        z = 12.0 + 3 * number
        car = KittiObject("Car", 0.0, 0, 0.1, (100, 120, 220, 190), (1.5, 1.7, 4.0), (1.0, 1.6, z), 0.2)
        found = [KittiObject("Car", -1, -1, 0.1, car.bbox, car.size, (1.0, 1.6, z + 0.2 * number), 0.2, 0.9)]
        found.append(KittiObject("Car", -1, -1, 0.1, (300, 120, 420, 190), car.size, (9.0, 1.6, z), 0.2, 0.4))
        for folder, objects in ((labels, [car]), (results, found)):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{number:06d}.txt").write_text("".join(f"{format_line(item)}\n" for item in objects))
    return tmp_path


def modules_of(wheel: Path) -> dict[str, str]:
    """Dotted name -> source, of the modules in the wheel."""
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if name.endswith(".py")]
        return {re.sub(r"/__init__$", "", name[:-3]).replace("/", "."): archive.read(name).decode() for name in names}


def test_the_wheel_is_closed_and_apart(wheel: Path) -> None:
    """No import leads out of it but to NumPy, Numba, and what is imported late; no file is the main distribution's."""
    modules = modules_of(wheel)
    assert all(name.split(".")[0] == "auglidar_eval" for name in modules)
    foreign, unknown = set(), []
    for name, source in modules.items():
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("auglidar_eval"):
                unknown += [
                    f"{name}: {node.module}.{alias.name}"
                    for alias in node.names
                    if node.module not in modules and f"{node.module}.{alias.name}" not in modules
                ]
            elif isinstance(node, (ast.Import, ast.ImportFrom)):
                named = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [str(node.module)]
                foreign |= {module.split(".")[0] for module in named} - sys.stdlib_module_names
    assert unknown == []
    assert foreign == {"numpy", "numba", "torch", "matplotlib"}


def test_the_code_is_that_of_the_repository(wheel: Path) -> None:
    for name, source in modules_of(wheel).items():
        original = ROOT / f"{name.removeprefix('auglidar_eval.').replace('.', '/')}.py"
        if original.is_file():
            assert source.replace("from auglidar_eval.", "from ") == original.read_text(encoding="utf-8"), name
    assert "auglidar_eval.detection.evaluation.matching" in modules_of(wheel)


def test_nothing_else_is_there_and_kernels_compile(installed: Path, tmp_path: Path) -> None:
    program = """
import importlib.util, numpy, auglidar_eval
from auglidar_eval.detection.evaluation.overlaps import _image_area
print([name for name in ("torch", "open3d", "scipy", "cv2", "yaml", "pydantic", "matplotlib", "detection", "pipeline")
       if importlib.util.find_spec(name)])
print(_image_area(numpy.array([1.0, 2.0, 4.0, 8.0])), len(_image_area.signatures))
"""
    assert call(installed, tmp_path, "python", "-c", program).split("\n")[:2] == ["[]", "18.0 1"]


def test_the_pages_commands_give_the_numbers_of_run_pipeline(installed: Path, desk: Path) -> None:
    lines = [line for block in blocks(PAGE) for line in block.splitlines() if line.startswith("auglidar-eval")]
    assert len(lines) == 3
    for line in lines:
        options = [*shlex.split(line)[1:], "--json", "alone.json", "--bootstrap", "5"]
        shown = call(installed, desk, "auglidar-eval", *options, **NOT_COMPILED)
        ours = [sys.executable, "-m", "pipeline.cli", "--stage", "evaluate", *options, "--json", "whole.json"]
        variables = {**NOT_COMPILED, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(ours, cwd=desk, env=variables, capture_output=True, text=True, check=True)
        assert shown == done.stdout
        assert json.loads((desk / "alone.json").read_text()) == json.loads((desk / "whole.json").read_text())
    rows = json.loads((desk / "alone.json").read_text())["recall"]
    assert [row["moderate"] for row in rows if row["class"] == "Car"] == [100.0, 100.0]


def test_the_pages_python_and_the_help_run(installed: Path, desk: Path) -> None:
    (snippet,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    printed = call(installed, desk, "python", "-c", snippet, **NOT_COMPILED)
    assert [line.split()[:2] for line in printed.splitlines()][:2] == [["2d", "0.7"], ["aos", "0.7"]]
    shown = call(installed, desk, "auglidar-eval", "--help")
    assert "auglidar-eval --labels KITTI" in shown
    assert "run_pipeline" not in shown


def test_curves_without_matplotlib_are_tables(installed: Path, desk: Path) -> None:
    command = "auglidar-eval --labels KITTI/training/label_2 --detections RESULTS --metrics 3d --curves curves"
    assert "wrote curves/scores.csv" in call(installed, desk, *shlex.split(command), **NOT_COMPILED)
    assert sorted(path.name for path in (desk / "curves").iterdir()) == ["curves.csv", "scores.csv"]


def test_the_lowest_versions_are_those_of_the_project() -> None:
    section = re.compile(r"\ndependencies = \[(.*?)\n\]", re.DOTALL)
    texts = [(folder / "pyproject.toml").read_text("utf-8") for folder in (ROOT, ROOT / "packages" / "auglidar-eval")]
    whole, alone = ({line.strip() for line in section.findall(text)[0].splitlines()} - {""} for text in texts)
    assert alone == {line for line in whole if line.startswith(('"numpy', '"numba'))}
    assert len(alone) == 2
