"""The documentation is true: its commands parse, some are run, its links, pictures and names exist."""

from __future__ import annotations

import ast
import importlib
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from pipeline.cli import main
from pipeline.run_folder.config import load_config
from pipeline.verbs import available_verbs
from pipeline.verbs.parsers import STAGE_HELP, main_parser, verb_parser
from tests.pipeline.tiny_kitti import write_tiny_kitti

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([*ROOT.glob("docs/*.md"), *ROOT.glob("[A-Z]*.md")])
FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
ROOMS = ("auglidar_base", "completion", "detection", "pipeline", "benchmarks")

pages = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def blocks(page: Path, language: str | None = None) -> Iterator[str]:
    for found in FENCE.finditer(page.read_text(encoding="utf-8")):
        if language is None or found.group(1) == language:
            yield found.group(2)


def prose(page: Path) -> str:
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def shell_lines(page: Path) -> list[str]:
    """Command lines of fenced blocks and of inline code, without prompts and comments; shell variables become 0."""
    lines = [line for block in blocks(page) for line in block.replace("\\\n", " ").splitlines()]
    lines += [code for code in re.findall(r"`([^`\n]+)`", prose(page)) if " " in code and "..." not in code]
    return [re.sub(r"\$\w+", "0", line.strip()) for line in lines]


def commands(page: Path, program: str) -> list[list[str]]:
    """The arguments of every call of `program` on a page."""
    calls = [line for line in shell_lines(page) if line.startswith(f"{program} ") or line == program]
    return [shlex.split(re.split(r"\s[|>]\s", call)[0], comments=True)[1:] for call in calls]


def stage_of(arguments: list[str]) -> str | None:
    return arguments[arguments.index("--stage") + 1] if "--stage" in arguments else None


@pages
def test_every_command_parses(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    verbs = available_verbs()
    for arguments in commands(page, "run_pipeline"):
        stage = stage_of(arguments)
        own = stage in verbs and not (stage == "evaluate" and "--labels" not in arguments)
        assert stage is None or stage in verbs or stage in STAGE_HELP, f"{page.name}: no stage {stage}"
        parser = verb_parser(str(stage), verbs[str(stage)]) if own else main_parser(verbs)
        try:
            parsed = parser.parse_args(arguments)
        except SystemExit as end:
            shown = capsys.readouterr().err.strip().splitlines()
            if end.code:
                pytest.fail(f"{page.name}: run_pipeline {shlex.join(arguments)}: {shown[-1:]}")
            continue
        if not own and (parsed.config is None or (ROOT / parsed.config).is_file()):
            load_config(parsed.config and str(ROOT / parsed.config), parsed.overrides)


@pages
def test_modules_and_scripts_exist(page: Path) -> None:
    for arguments in commands(page, "python"):
        if arguments[:1] == ["-m"]:
            assert importlib.util.find_spec(arguments[1]) is not None, f"{page.name}: python -m {arguments[1]}"
        elif arguments:
            assert (ROOT / arguments[0]).is_file(), f"{page.name}: python {arguments[0]}"


@pages
def test_make_targets_exist(page: Path) -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for arguments in commands(page, "make"):
        asked = {word for word in arguments if "=" not in word and word.isalpha()}
        assert asked <= targets, f"{page.name}: make {asked - targets}"


def slug(title: str) -> str:
    kept = re.sub(r"[^\w\s-]", "", re.sub(r"[`*]", "", title).strip().lower())
    return re.sub(r"\s+", "-", kept)


@pages
def test_links_and_pictures_exist(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if target.startswith(("https://", "http://", "mailto:")):
            continue
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.exists(), f"{page.name}: {target} does not exist"
        if anchor:
            titles = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in map(slug, titles), f"{page.name}: no heading {anchor} in {path.name}"


def resolves(name: str) -> bool:
    """Whether a dotted name is a module, or something in one."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:end]))
        except ImportError:
            continue
        for attribute in parts[end:]:
            if not hasattr(found, attribute):
                return attribute in getattr(found, "__annotations__", {})
            found = getattr(found, attribute)
        return True
    return False


@pages
def test_named_functions_exist(page: Path) -> None:
    for code in re.findall(r"`([^`\n]+)`", prose(page)):
        name = re.match(rf"((?:{'|'.join(ROOMS[:4])})(?:\.\w+)+)", code)
        # completion.model and the like are keys of the configuration.
        if name is None or name.group(1).split(".")[1] in ("model", "device", "backend", "options"):
            continue
        assert resolves(name.group(1)), f"{page.name}: {name.group(1)} does not exist"


@pages
def test_named_source_files_exist(page: Path) -> None:
    for room, rest in re.findall(rf"`({'|'.join((*ROOMS, 'configs', 'tests', 'scripts'))})/([\w/.-]+)", prose(page)):
        path = ROOT / room / rest.rstrip(".")
        # pipeline/configs is made by the installation (setup.py).
        assert path.exists() or "NAME" in rest or f"{room}/{rest}" == "pipeline/configs", (
            f"{page.name}: {room}/{rest} does not exist"
        )


@pages
def test_python_blocks_import_what_exists(page: Path) -> None:
    for block in blocks(page, "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] in ROOMS:
                for alias in node.names:
                    assert resolves(f"{node.module}.{alias.name}"), f"{page.name}: {node.module}.{alias.name}"


@pages
def test_pages_name_no_machine(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for found in ("/work/", "/home/", "/tmp/", "pypi.", "pythonhosted", "download.pytorch"):
        assert found not in text, f"{page.name}: {found}"


def test_every_page_is_in_the_menu() -> None:
    menu = (ROOT / "zensical.toml").read_text(encoding="utf-8")
    missing = [page.name for page in ROOT.glob("docs/*.md") if f'"{page.name}"' not in menu]
    assert not missing


def runnable(page: str, *stages: str) -> list[list[str]]:
    """The commands of a page with one of these stages, as they stand there."""
    return [call for call in commands(ROOT / "docs" / page, "run_pipeline") if stage_of(call) in stages]


@pytest.mark.parametrize(
    ("page", "stages", "expected"),
    [
        ("kitti.md", ("check", "augment"), "runs/kitti/cloud/000001.bin"),
        ("virtual-points.md", ("complete", "augment", "export", "check"), "exports/sfd/training"),
    ],
)
def test_pages_work_as_written(
    page: str, stages: tuple[str, ...], expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The commands of a page, one after the other, on two tiny frames called KITTI."""
    write_tiny_kitti(tmp_path / "KITTI", 2)
    monkeypatch.chdir(tmp_path)
    calls = runnable(page, *stages)
    assert len(calls) >= 3
    for call in calls:
        if "--frames" in call:
            call[call.index("--frames") + 1] = "0:2"
        code = main([*call, "--workers", "1"])
        # The doctor may find fault with tiny images; a request that cannot be carried out is 2.
        assert code == 0 or (stage_of(call) == "check" and code == 1), f"{page}: {shlex.join(call)} ended with {code}"
    assert (tmp_path / expected).exists()


def test_python_of_other_networks_runs(tmp_path: Path) -> None:
    write_tiny_kitti(tmp_path / "KITTI", 1)
    program = "\n".join(blocks(ROOT / "docs" / "other-networks.md", "python"))
    assert "near_lidar" in run_python(program, tmp_path)


def run_python(program: str, folder: Path) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("name", ["completion", "evaluation"])
def test_notebooks_run(name: str, tmp_path: Path) -> None:
    cells = json.loads((ROOT / "notebooks" / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all(cell["outputs"] for cell in code if "print(" in "".join(cell["source"])), "stored without outputs"
    shown = run_python("\n".join("".join(cell["source"]) for cell in code), tmp_path)
    assert {"completion": "near_lidar", "evaluation": "perfect"}[name] in shown


def test_reference_covers_what_users_import(tmp_path: Path) -> None:
    program = (
        "from pathlib import Path; from scripts.build_docs import write_sources; "
        f"write_sources(Path({str(tmp_path / 'docs')!r}))"
    )
    run_python(program, ROOT)
    reference = "\n".join(page.read_text(encoding="utf-8") for page in (tmp_path / "docs" / "api").glob("*.md"))
    for name in ("load_completer", "depth_metrics", "import_checkpoint", "furthest_point_sample", "evaluate",
                 "augment_frame", "open_dataset", "project_points"):  # fmt: skip
        assert f"### `{name}`" in reference, name
    check_list_of_pages(tmp_path / "docs")
    pages_of_site = [*(tmp_path / "docs").glob("*.md")]
    assert not [page.name for page in pages_of_site if "](../" in page.read_text(encoding="utf-8")]


def check_list_of_pages(built: Path) -> None:
    """llms.txt: a title, a sentence, and one line with a sentence for every page of the site but the front page."""
    lines = (built / "llms.txt").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "# AugLiDAR"
    assert lines[2].startswith("> Sparse LiDAR and one camera image in; dense depth")
    listed = dict(re.findall(r"^- \[[^\]]+\]\(([^)]+)\.html\): (.*)$", "\n".join(lines), re.MULTILINE))
    menu = set(re.findall(r'"([^"]+)\.md"', (ROOT / "zensical.toml").read_text(encoding="utf-8")))
    assert set(listed) == menu - {"index"}
    wrong = [
        f"{page}: {text}" for page, text in listed.items() if len(text) < 20 or text[-1] not in ".?" or "](" in text
    ]
    assert wrong == []
    assert (
        listed["cluster"]
        == "A run on n machines is n processes with `--shard i/n`, counted from 0, and one shared folder."
    )
    assert {"## Tasks", "## Reference", "## Understand"} <= set(lines)


def test_citation_is_complete() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors", "version", "license"} <= set(citation)
    assert f'version = "{citation["version"]}"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def test_dockerfile() -> None:
    """What a linter would say: pinned base, no cache left, an ordinary user, sources that exist, exec form."""
    lines = (ROOT / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ").splitlines()
    steps = [line for line in lines if line and not line.startswith("#")]
    assert re.match(r"FROM \S+:\S+", next(line for line in steps if line.startswith("FROM")))
    assert "rm -rf /var/lib/apt/lists" in next(line for line in steps if "apt-get install" in line)
    assert "--no-cache-dir" in next(line for line in steps if "pip install" in line)
    assert [line for line in steps if line.startswith("USER")][-1] != "USER root"
    assert steps[-1] == 'ENTRYPOINT ["run_pipeline"]'
    for line in (line for line in steps if line.startswith("COPY")):
        for source in line.split()[1:-1]:
            assert (ROOT / source).exists(), source
    needed = re.findall(r"([\w.-]+):lib\S+", (ROOT / "scripts" / "setup").read_text(encoding="utf-8"))
    assert all(package in "".join(steps) for package in needed)
