"""Every verb's --help ends with examples: all are taken by its parser, and those that take no minutes are run."""

from __future__ import annotations

import pickle
import re
import shlex
from pathlib import Path

import pytest

from detection.kitti_format import KittiObject, format_line
from pipeline.cli import main
from pipeline.verbs import VERBS
from pipeline.verbs.parsers import verb_parser
from tests.pipeline.tiny_kitti import write_tiny_kitti
from tests.pipeline.verbs.test_results_import import entry

# Pattern of an example -> why it is not run here.
NOT_RUN = {
    r"--stage bench": "measures for minutes: tests/pipeline/benchmark",
    r"--figure .* --budget smoke": "computes figures for minutes: tests/pipeline/experiments",
    r"TWISE\.tar": "needs a published file: tests/completion/test_importers.py",
}
CAR = KittiObject("Car", -1, -1, -1.5, (100, 100, 180, 160), (1.5, 1.6, 3.9), (1.0, 1.7, 20.0), -1.45, 0.9)


def examples(verb: str) -> list[str]:
    """The commands in the help of a verb; "..." stands for the command above it, comments and redirections are cut."""
    shown = verb_parser(verb, VERBS[verb][1]).format_help()
    text = shown[re.search(r"(?m)^examples?\b", shown).start() :].replace("\\\n", " ")  # type: ignore[union-attr]
    found: list[str] = []
    for line in text.splitlines():
        command = re.search(r"run_pipeline [^>\")]*", line)
        more = re.match(r"  \.\.\. (.*?)(?: {3,}|$)", line)
        if command:
            found.append(" ".join(command[0].split()))
        elif more:
            found.append(f"{found[0]} {more[1]}")
    return found


@pytest.mark.parametrize("verb", VERBS)
def test_examples_are_taken_by_the_parser(verb: str) -> None:
    shown = examples(verb)
    assert shown
    for command in shown:
        args = verb_parser(verb, "").parse_args(shlex.split(command)[1:])
        assert args.stage == verb, command


def test_a_wrong_example_would_be_found() -> None:
    with pytest.raises(SystemExit):
        verb_parser("evaluate", "").parse_args(["--labels", "a", "--detection", "b"])
    assert len(examples("evaluate")) == 3
    assert examples("evaluate")[2].endswith("--explain --json scores.json")


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder a reader works in: KITTI, a run of it, results of the test split, a result pickle."""
    monkeypatch.chdir(tmp_path)
    kitti = write_tiny_kitti(tmp_path / "KITTI", 2)
    (kitti / "ImageSets").mkdir()
    (kitti / "ImageSets" / "val.txt").write_text("000000\n000001\n")
    run = "--config configs/kitti.yaml --data KITTI --out runs/kitti --stage augment --workers 1"
    assert main([*run.split(), "--set", "completion.model=classical"]) == 0
    (tmp_path / "DEPTH").symlink_to(tmp_path / "runs" / "kitti" / "depth")
    for folder, frames in (("runs/kitti/detections", 2), ("runs/test/detections", 7518)):
        (tmp_path / folder).mkdir(parents=True)
        for number in range(frames):
            (tmp_path / folder / f"{number:06d}.txt").write_text(f"{format_line(CAR)}\n" if number < 2 else "")
    (tmp_path / "result.pkl").write_bytes(pickle.dumps([entry(1, frame_id="000000")]))
    return tmp_path


def test_examples_run(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done = []
    for verb in VERBS:
        for command in examples(verb):
            if any(re.search(pattern, command) for pattern in NOT_RUN):
                continue
            code = main(shlex.split(command)[1:])
            # The doctor may find fault with tiny images; a request that cannot be carried out is 2.
            assert code == 0 or (verb == "check" and code == 1), f"{command}: {code}\n{capsys.readouterr().err[-800:]}"
            done.append(verb)
    assert set(done) == set(VERBS) - {"bench"}
    for made in ("exports/openpcdet", "scores.json", "report.json", "submission.zip", "detections/000000.txt"):
        assert (desk / made).exists(), made
