"""What is installed works: the sdist, the wheel made from it, an environment that holds nothing else of ours, Docker.

The wheel is installed into a new virtual environment that borrows the dependencies of the one at hand; the product's
own files come from the wheel alone, and everything is run from another folder.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.pipeline.tiny_kitti import write_tiny_kitti

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("auglidar_base", "completion", "detection", "pipeline", "configs")
NOT_SHIPPED = {"__pycache__", ".venv", ".git"}


def source_files() -> set[str]:
    """Files of the packages and of configs/, relative to the checkout."""
    return {
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and not NOT_SHIPPED & set(path.parts) and path.suffix not in (".nbi", ".nbc", ".pyc")
    }


def copy_of_checkout(target: Path) -> Path:
    """The files that a build reads, without leftovers of earlier builds."""
    for name in source_files():
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, target / name)
    for name in ("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff"):
        shutil.copy(ROOT / name, target / name)
    return target


def wheel_from_sdist(source: Path, folder: Path) -> Path:
    """The wheel built from the sdist, so that a file missing from either is missing here."""
    sdist = build("sdist", source, folder)
    with tarfile.open(sdist) as archive:
        archive.extractall(folder / "unpacked", filter="data")
    (unpacked,) = (folder / "unpacked").iterdir()
    return build("wheel", unpacked, folder)


def build(kind: str, source: Path, out: Path) -> Path:
    """An sdist or a wheel of the source tree, by the project's own build backend."""
    call = f"from setuptools import build_meta; print(build_meta.build_{kind}({str(out)!r}))"
    done = subprocess.run([sys.executable, "-c", call], cwd=source, capture_output=True, text=True, check=True)
    return out / done.stdout.split()[-1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    return wheel_from_sdist(copy_of_checkout(folder / "checkout"), folder)


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin folder of an environment with this wheel and the dependencies of the environment at hand."""
    folder = tmp_path_factory.mktemp("environment")
    return install(wheel, folder)


def install(what: Path, folder: Path, borrowed: Sequence[str] = ()) -> Path:
    """A new environment with `what` (a wheel or a source tree) and borrowed dependencies; returns its bin folder.

    borrowed  folders of the site-packages at hand that are all it has; empty: everything there
    """
    venv.create(folder, with_pip=False)
    site = Path(sysconfig.get_path("purelib", vars={"base": str(folder), "platbase": str(folder)}))
    here = Path(sysconfig.get_path("purelib"))
    if borrowed:
        for name in borrowed:
            (site / name).symlink_to(here / name)
    else:
        # A .pth file inside a borrowed folder is not read, so the editable installation there stays out of sight.
        (site / "borrowed.pth").write_text(f"{here}\n", encoding="utf-8")
    pip = [sys.executable, "-m", "pip", "--python", str(folder / "bin" / "python"), "--disable-pip-version-check"]
    options = ["install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation", str(what)]
    subprocess.run([*pip, *options], check=True, capture_output=True)
    return folder / "bin"


def call(installed: Path, folder: Path, *words: str, **variables: str) -> str:
    """Output of a command of the environment, run in `folder` without anything of this checkout on the path."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "AUGLIDAR"))}
    environment |= variables
    done = subprocess.run(
        [installed / words[0], *words[1:]], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{' '.join(words)}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout


def test_the_wheel_holds_every_file(wheel: Path) -> None:
    """Fails when one weight file, card, configuration or template is left out of the package data."""
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    wanted = {re.sub(r"^configs/", "pipeline/configs/", name) for name in source_files()}
    assert sorted(held ^ wanted) == []
    assert sum(name.endswith(".safetensors") for name in held) >= 7


@pytest.mark.slow
def test_the_demo_runs_from_the_wheel(installed: Path, tmp_path: Path) -> None:
    shown = call(installed, tmp_path, "run_pipeline", "--set", "synth.frames=4", "--workers", "1")
    assert "Car" in shown
    assert (tmp_path / "runs/demo/report/index.html").is_file()
    assert len(list((tmp_path / "runs/demo/detections").glob("*.txt"))) == 4


@pytest.mark.slow
def test_kitti_and_the_readmes_snippet_run_from_the_wheel(installed: Path, tmp_path: Path) -> None:
    write_tiny_kitti(tmp_path / "KITTI", 9)
    command = "--config configs/kitti.yaml --data KITTI --out runs/kitti --stage detect --workers 1"
    call(installed, tmp_path, "run_pipeline", *command.split())
    assert (tmp_path / "runs/kitti/detections/000008.txt").is_file()
    (snippet,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    printed = call(installed, tmp_path, "python", "-c", snippet + "\nimport pipeline\nprint(pipeline.__file__)")
    assert str(installed.parent) in printed


def test_shipped_experiments_and_weights_are_found(installed: Path, tmp_path: Path) -> None:
    shipped = "configs/experiments/table-5.3.yaml"
    planned = call(installed, tmp_path, "run_pipeline", "--stage", "experiment", "--config", shipped, "--dry-run")
    assert "5.3" in planned
    shown = call(installed, tmp_path, "run_pipeline", "--stage", "env")
    assert "selection_small" in shown
    assert "small_lidar" in shown
    assert "street-small" in shown


def docker_lines() -> list[tuple[str, str]]:
    """(instruction, rest) of the Dockerfile, continuation lines joined, comments gone."""
    text = re.sub(r"(?m)^#.*\n", "", (ROOT / "Dockerfile").read_text(encoding="utf-8")).replace("\\\n", " ")
    return [(line.split(None, 1)[0], line.split(None, 1)[1].strip()) for line in text.splitlines() if line.strip()]


def test_the_dockerfile_works_in_a_clean_folder(tmp_path: Path) -> None:
    """Its commands in order, without an engine: copies come from the checkout, pip takes the borrowed dependencies.

    System packages and users are the engine's business; of those lines only the syntax is checked.
    """
    context, image = copy_of_checkout(tmp_path / "context"), tmp_path / "image"
    image.mkdir()
    installed = None
    for instruction, rest in docker_lines():
        if instruction == "COPY":
            *sources, target = rest.split()
            for source in sources:
                place = image if target == "./" else image / target
                if (context / source).is_dir():
                    shutil.copytree(context / source, place)
                else:
                    shutil.copy(context / source, place)
        elif instruction == "RUN":
            subprocess.run(["bash", "-n", "-c", rest], check=True)
            if "pip install" in rest:
                assert re.search(r"pip install --no-cache-dir \.(\s|$)", rest)
                installed = install(image, tmp_path / "environment")
    assert installed is not None
    (entry,) = [rest for instruction, rest in docker_lines() if instruction == "ENTRYPOINT"]
    assert entry == '["run_pipeline"]'
    assert "selection_small" in call(installed, tmp_path, "run_pipeline", "--stage", "env")
