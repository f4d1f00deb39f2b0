"""CI, hooks and templates say the same as pyproject.toml and run what a developer runs."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml

import pipeline
from tests.conftest import slow_tests

ROOT = Path(__file__).resolve().parent.parent
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def read_yaml(name: str) -> Any:
    return yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))


def test_ci_runs_the_two_commands_on_every_supported_python() -> None:
    jobs = read_yaml(".github/workflows/ci.yml")["jobs"]
    runs = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert [run for run in runs if run.startswith("make")] == ["make check", "make test"]
    low, high = re.findall(r'requires-python = ">=3\.(\d+),<3\.(\d+)"', PROJECT)[0]
    matrix = jobs["test"]["strategy"]["matrix"]
    assert matrix["python"] == [f"3.{minor}" for minor in range(int(low), int(high))]
    assert matrix["include"] == [{"python": f"3.{low}", "dependencies": "lowest"}]


def test_the_lowest_dependencies_are_those_of_the_project() -> None:
    section = PROJECT.partition("\ndependencies = [")[2].partition("\n]")[0]
    bounds = dict(re.findall(r'"([\w-]+)>=([\d.]+)', section))
    lines = (ROOT / ".ci" / "lowest.txt").read_text(encoding="utf-8").splitlines()
    pinned = dict(line.split("==") for line in lines if not line.startswith("#"))
    assert {name: version.removesuffix(".*") for name, version in pinned.items()} == bounds


def test_hooks_run_programs_of_the_environment() -> None:
    checks = (ROOT / "scripts" / "check").read_text(encoding="utf-8")
    hooks = [hook for repo in read_yaml(".pre-commit-config.yaml")["repos"] for hook in repo["hooks"]]
    for hook in hooks:
        program = hook["entry"].split()[0].removeprefix(".venv/bin/")
        assert f"$bin/{program}" in checks
    assert len(hooks) == checks.count("$bin/")


def test_templates_ask_for_what_contributing_asks_for() -> None:
    for path in sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")):
        content = read_yaml(str(path.relative_to(ROOT)))
        if path.name != "config.yml":
            assert {"name", "description", "body"} <= set(content)
    assert "run_pipeline --stage env --json" in (ROOT / ".github/ISSUE_TEMPLATE/bug.yml").read_text(encoding="utf-8")


def test_one_version_everywhere() -> None:
    (version,) = re.findall(r'^version = "([^"]+)"', PROJECT, re.MULTILINE)
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    alone = (ROOT / "packages" / "auglidar-eval" / "pyproject.toml").read_text(encoding="utf-8")
    assert re.findall(r'^version = "([^"]+)"', alone, re.MULTILINE) == [version]
    assert version == pipeline.__version__ == str(read_yaml("CITATION.cff")["version"])
    assert re.findall(r"^## (\S+)", changelog, re.MULTILINE)[0] in (version, "Unreleased")


def test_slow_tests_are_there_and_fast_leaves_them_out() -> None:
    """Every listed test exists, and `scripts/test --fast` names a room that has none of them."""
    for name in slow_tests():
        file, _, function = name.partition("::")
        assert f"def {function}(" in (ROOT / file).read_text(encoding="utf-8"), name
    room = [sys.executable, "-m", "pytest", "--collect-only", "-p", "no:xdist", "tests/completion/cpu"]
    every, fast = (
        set(subprocess.run([*room, *more], cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines())
        for more in ([], ["--fast"])
    )
    left_out = {line.split("[")[0] for line in every - fast if "::" in line}
    assert left_out
    assert left_out <= slow_tests()


def test_a_room_without_tests_is_refused() -> None:
    done = subprocess.run(["scripts/test", "--fast", "cellar"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "tests/pipeline/cellar" in done.stderr
