"""The environment report and the shell completion."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from pipeline.cli import main
from pipeline.verbs import VERBS
from pipeline.verbs.env import EXTRAS, environment, remarks
from pipeline.verbs.parsers import STAGE_HELP
from pipeline.verbs.shell import script


def test_report_as_json(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["--stage", "env", "--json", "--out", str(tmp_path / "not" / "yet")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["versions"]["torch"]
    assert found["disk"]["folder"] == str(tmp_path)
    assert found["cores"] >= 1


def test_report_as_text_says_where_python_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--stage", "env"]) == 0
    shown = capsys.readouterr().out
    assert "executable" in shown
    assert "GB free at" in shown


def test_remarks_name_the_trouble(tmp_path: Path) -> None:
    found = environment(tmp_path)
    found["disk"]["free_gb"] = 0.4
    found["memory_gb"]["available"] = 0.5
    found["weights"]["detection"] = []
    found["versions"]["torch"], found["gpus"] = "2.13.0+cpu", ["NVIDIA H200"]
    notes = remarks(found)
    assert any("0.4 GB free" in note for note in notes)
    assert any("fewer --workers" in note for note in notes)
    assert any("detection.model" in note for note in notes)
    assert any("build for CPUs" in note for note in notes)


def test_no_remark_without_trouble(tmp_path: Path) -> None:
    found = environment(tmp_path)
    found["disk"]["free_gb"] = 500.0
    found["memory_gb"]["available"] = 1000.0
    found["weights"]["detection"] = ["small_lidar"]
    found["gpus"] = []
    assert remarks(found) == []


def test_gpus_are_those_of_the_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "nvidia-smi"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert environment(tmp_path)["gpus"] == []
    program.write_text("#!/bin/sh\nprintf 'NVIDIA H200\\nNVIDIA L4\\n'\n")
    program.chmod(0o755)
    assert environment(tmp_path)["gpus"] == ["NVIDIA H200", "NVIDIA L4"]
    program.write_text("#!/bin/sh\nexit 9\n")
    assert environment(tmp_path)["gpus"] == []


def completions(*words: str) -> set[str]:
    """What bash offers for the last of `words`."""
    if shutil.which("bash") is None:
        pytest.skip("bash is not installed")
    program = (
        f"{script('bash')}\nCOMP_WORDS=({' '.join(repr(word) for word in words)})\n"
        f'COMP_CWORD={len(words) - 1}\n_run_pipeline\nprintf "%s\\n" "${{COMPREPLY[@]}}"'
    )
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_tab_offers_every_stage_and_verb() -> None:
    assert completions("run_pipeline", "--stage", "") >= {*STAGE_HELP, "export", "check", "env"} - {"import"}
    assert completions("run_pipeline", "--stage", "ex") <= {name for name in VERBS if name.startswith("ex")}


def test_tab_offers_the_options_of_the_stage() -> None:
    assert completions("run_pipeline", "--stage", "export", "--form") == {"--format"}
    assert completions("run_pipeline", "--stage", "complete", "--virt") == set()
    assert completions("run_pipeline", "--stage", "complete", "--sha") == {"--shard"}


def test_zsh_uses_its_bash_layer() -> None:
    assert script("zsh").startswith("autoload -Uz bashcompinit")


def test_extras_are_those_of_the_package() -> None:
    """Every optional extra but the developers' own is reported."""
    text = (Path(__file__).resolve().parents[3] / "pyproject.toml").read_text(encoding="utf-8")
    table = text.split("[project.optional-dependencies]")[1].split("[project.scripts]")[0]
    declared = {line.split(" = ")[0] for line in table.splitlines() if " = [" in line}
    assert set(EXTRAS) == declared - {"dev", "bench"}
