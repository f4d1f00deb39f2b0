"""A completion method and a detector of one's own, as docs/own-methods.md writes them: detect, bench, experiment."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from detection.kitti_format import parse_lines
from pipeline.cli import main
from pipeline.data.depth_png import read_depth_png
from pipeline.experiments.catalogue import find
from pipeline.experiments.config import read_config
from pipeline.experiments.further_rows import with_rows
from pipeline.experiments.plan import Order, carry_out, gather, make_plan
from pipeline.run_folder.own_methods import own_files
from tests.pipeline.tiny_kitti import tiny_frame, write_tiny_kitti

PAGE = Path(__file__).resolve().parents[2] / "docs" / "own-methods.md"
MEDIAN, ONE_CAR = "my_methods:Median", "my_methods:OneCar"


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with the page's my_methods.py and two frames, in which the commands are given."""
    (code,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    (tmp_path / "my_methods.py").write_text(code)
    write_tiny_kitti(tmp_path / "KITTI", 2)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    sys.modules.pop("my_methods", None)


def command(stage: str, *settings: str, workers: int = 1) -> list[str]:
    words = ["--config", "kitti", "--data", "KITTI", "--out", "run", "--stage", stage, "--workers", str(workers)]
    return [*words, *(word for setting in settings for word in ("--set", setting))]


def test_worker_processes_complete_and_detect_with_ones_own_classes(desk: Path) -> None:
    own = f"completion.model={MEDIAN}", "completion.options.scale=1.5", f"detection.model={ONE_CAR}"
    assert main(command("detect", *own, "detection.options.score=0.7", workers=2)) == 0
    sparse = tiny_frame(1).sparse_depth
    expected = 1.5 * np.median(sparse[sparse > 0])
    depth = read_depth_png(desk / "run" / "depth" / "000001.png")
    np.testing.assert_allclose(depth, expected, atol=1 / 256)
    (found,) = parse_lines((desk / "run" / "detections" / "000001.txt").read_text(), scored=True)
    assert (found.type, found.score) == ("Car", 0.7)


def test_a_changed_source_or_option_redoes_the_stage_and_nothing_else_does(desk: Path) -> None:
    again = command("complete", f"completion.model={MEDIAN}")
    depth = desk / "run" / "depth" / "000000.png"

    def redone(words: list[str]) -> bool:
        before = depth.stat().st_mtime_ns
        assert main(words) == 0
        return depth.stat().st_mtime_ns != before

    assert main(again) == 0
    assert not redone(again)
    source = desk / "my_methods.py"
    source.write_text(source.read_text() + "\n# changed\n")
    assert redone(again)
    assert redone([*again, "--set", "completion.options.scale=2"])


def test_source_covers_neighbours_and_files_of_options(desk: Path) -> None:
    (desk / "helper.py").write_text("import nothing_here\n")
    (desk / "stranger.py").write_text("")
    (desk / "weights.bin").write_bytes(b"1")
    (desk / "my_methods.py").write_text(
        "import json\nfrom helper import a\nclass Own:\n    def __init__(self, weights): ...\n"
        "    def complete(self, sparse, image, K=None): ...\n"
    )
    (desk / "helper.py").write_text("a = 1\n")
    files = own_files("completion", "my_methods:Own", {"weights": "weights.bin"})
    sys.modules.pop("helper", None)
    assert [path.name for path in files] == ["helper.py", "my_methods.py", "weights.bin"]


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (["completion.model=no_such:Median"], "no_such cannot be imported"),
        (["completion.model=my_methods:Mean"], "has no class 'Mean'"),
        ([f"completion.model={ONE_CAR}"], "complete(self, sparse, image, K=None)"),
        ([f"completion.model={MEDIAN}", "completion.options.size=3"], "does not take these completion.options: size"),
        ([f"detection.model={MEDIAN}"], "detect(self, frame)"),
        (["completion.model=subprocess:Popen", "completion.options.args=ls"], "expected a class with the method"),
    ],
)
def test_what_cannot_be_used_is_told_in_one_line_before_anything_runs(
    settings: list[str], told: str, desk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command("detect", *settings)) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert told in lines[-1]
    assert "Traceback" not in "".join(lines)
    assert not (desk / "run" / "depth").exists()


def test_a_result_that_is_no_depth_map_is_the_frames_failure(desk: Path) -> None:
    (desk / "my_methods.py").write_text(
        "class Half:\n    def complete(self, sparse, image, K=None):\n        return sparse[::2]\n"
    )
    assert main(command("complete", "completion.model=my_methods:Half")) == 1
    failures = json.loads((desk / "run" / "failures.json").read_text())
    listed = json.dumps(failures)
    assert all(part in listed for part in ("my_methods:Half", "(48, 96)", "(24, 96)"))


def test_bench_measures_them(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--stage", "bench", "--data", "KITTI", "--rows", "16", "--masks", "", "--json"]
    assert main([*words, "--completers", f"nearest,{MEDIAN}", "--detectors", ONE_CAR]) == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert [entry["method"] for entry in found["completion"]] == ["nearest", MEDIAN]
    assert {entry["detector"] for entry in found["detection"]} == {ONE_CAR}
    assert found["detection_depth"] == MEDIAN
    assert main([*words, "--completers", "my_methods:Mean"]) == 2
    assert "has no class 'Mean'" in capsys.readouterr().err


def test_bench_says_which_depth_makes_the_clouds_of_its_detectors(
    desk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--stage", "bench", "--data", "KITTI", "--rows", "16", "--masks", ""]
    assert main([*words, "--completers", "", "--detectors", ONE_CAR]) == 0
    printed = capsys.readouterr()
    assert "made from the depth of classical" in printed.err
    assert "augmented clouds from classical" in printed.out


def test_tables_take_further_rows(desk: Path) -> None:
    (desk / "rows.yaml").write_text(
        'table: ["4.5", "5.3"]\nbudget: smoke\nseeds: 1\nrows:\n'
        '  - {table: "4.5", label: "median", completer: "my_methods:Median", options: {scale: 1.02}}\n'
        '  - {table: "5.3", label: "one car", like: "PointRCNN2, D", detector: "my_methods:OneCar",'
        ' input: {preset: D, depth: "my_methods:Median"}}\n'
    )
    config = read_config(desk / "rows.yaml")
    tables = with_rows([find("table", "4.5"), find("table", "5.3")], config.rows)
    only = tuple(replace(table, rows=table.rows[-1:], claims=()) for table in tables)
    plan = make_plan(Order(only, desk / "out", "smoke", 1))
    keys = [run.key for run in plan.all_runs()]
    carry_out(plan, lambda text: None)
    depth, boxes = (gather(plan, table).outcomes[table.rows[0].label][0].numbers for table in only)
    assert depth["mae_mm"] > 100
    assert 0 <= boxes["bev_0.5_moderate"] <= 100
    source = desk / "my_methods.py"
    source.write_text(source.read_text() + "\n# changed\n")
    assert not set(keys) & {run.key for run in make_plan(plan.order).all_runs()}


@pytest.mark.parametrize(
    ("row", "told"),
    [
        ("{detector: x}", "expected a label"),
        ('{label: a, like: "PointRCNN, D"}', "like: "),
        ("{label: a, detektor: x}", "unknown setting 'detektor'"),
        ('{label: a, table: "5.4"}', "table 5.4 is not asked for"),
        ("{label: a, detector: my_methods:Two}", "has no class 'Two'"),
    ],
)
def test_wrong_rows_are_told_in_one_line(row: str, told: str, desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (desk / "rows.yaml").write_text(f'table: "5.3"\nbudget: smoke\nrows: [{row}]\n')
    assert main(["--stage", "experiment", "--config", "rows.yaml", "--out", "out"]) == 2
    assert told in capsys.readouterr().err
    assert not (desk / "out").exists()
