"""The shell commands of the documentation, run one after the other as a reader would, on tiny data."""

from __future__ import annotations

import importlib.util
import re
import shlex
import shutil
from pathlib import Path

import pytest

from detection.kitti_format import format_line
from pipeline.cli import main
from pipeline.data.kitti_object import read_labels
from tests.doc_commands import PAGES, ROOT, STORY, commands, reason_not_run
from tests.pipeline.data.vkitti2_tree import write_tree
from tests.pipeline.tiny_kitti import write_tiny_kitti


def page(name: str) -> Path:
    return ROOT / name if name == "README.md" else ROOT / "docs" / name


def test_every_command_is_run_or_has_a_reason() -> None:
    open_questions = [
        f"{path.name}: {command}"
        for path in PAGES
        if path.name not in STORY
        for command in commands(path)
        if reason_not_run(command) is None
    ]
    assert not open_questions, "put the page into STORY or a reason into NOT_RUN of tests/doc_commands.py"


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder a reader works in: KITTI, VKITTI2, a split, labels and a data set of one's own."""
    kitti = write_tiny_kitti(tmp_path / "KITTI", 4)
    (kitti / "object").symlink_to(kitti)
    (kitti / "ImageSets").mkdir()
    for name, ids in (("train", "000000\n000001\n"), ("val", "000002\n000003\n")):
        (kitti / "ImageSets" / f"{name}.txt").write_text(ids)
    shutil.copy(kitti / "ImageSets" / "val.txt", tmp_path / "val.txt")
    write_tree(tmp_path / "VKITTI2", "Scene01", 2)
    own = tmp_path / "MY_DATA"
    for source, target in (("image_2", "images"), ("velodyne", "points"), ("calib", "calib")):
        shutil.copytree(kitti / "training" / source, own / target)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "NAME").symlink_to("kitti")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "0")
    return tmp_path


def prepare(name: str, desk: Path) -> None:
    """What the page says one has by now."""
    if name == "other-networks.md":
        shutil.copytree(desk / "runs" / "kitti" / "depth", desk / "DEPTH")
    if name == "own-methods.md":
        (code,) = re.findall(r"^```python\n(.*?)^```", page(name).read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
        (desk / "my_methods.py").write_text(code)
    if name == "report.md":
        for copy in ("augmented", "lidar_only"):
            shutil.copytree(desk / "runs" / "kitti", desk / "runs" / copy)
    if name == "doctor.md":
        shutil.copytree(desk / "runs" / "kitti" / "detections", desk / "RESULTS")
    if name == "noise.md":
        (code,) = re.findall(r"^```python\n(.*?)^```", page(name).read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
        exec(compile(code, name, "exec"), {"__name__": "__main__"})
        (desk / "LABELS").mkdir()
        for run in ("exact", "smeared"):
            (desk / "runs" / run / "detections").mkdir(parents=True)
        for number in range(2):
            objects = read_labels(desk / "KITTI" / "training" / "label_2" / f"00000{number}.txt")
            (desk / "LABELS" / f"00000{number}.txt").write_text("".join(format_line(o) + "\n" for o in objects))
            for run in ("exact", "smeared"):
                (desk / "runs" / run / "detections" / f"00000{number}.txt").write_text("")


def run(command: str) -> int:
    """The exit code of one command line of `run_pipeline`, in this process."""
    words = shlex.split(re.sub(r"\$\{?SLURM_ARRAY_TASK_ID\}?", "0", command))[1:]
    verb = {"--help", "check", "env", "shell", "export", "evaluate"} & set(words)
    if not verb or (verb == {"evaluate"} and "--labels" not in words):
        words += ["--workers", "1"]
    try:
        return main(words)
    except SystemExit as end:
        return int(end.code or 0)


@pytest.mark.slow
def test_commands_run(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done = []
    for name in STORY:
        prepare(name, desk)
        for command in commands(page(name)):
            if reason_not_run(command) is not None:
                continue
            if "--format rrd" in command and importlib.util.find_spec("rerun") is None:
                continue
            code = run(command)
            # The doctor may find fault with tiny images; a request that cannot be carried out is 2.
            fine = code == 0 or ("--stage check" in command and code == 1)
            assert fine, f"{name}: {command}: exit code {code}\n{capsys.readouterr().err[-800:]}"
            done.append(command)
    assert len(done) > 40
    for made in (
        "runs/kitti/report/index.html",
        "exports/sfd/training",
        "exports/virconv",
        "runs/mine/cloud",
        "counts.json",
    ):
        assert (desk / made).exists(), made
