"""Experiments from the command line at budget smoke: real trainings on two frames."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipeline.cli import main
from pipeline.experiments.config import read_config
from pipeline.experiments.plan import Order, estimate_cost, make_plan
from pipeline.experiments.runs import budget_of, do_run, plan_run

ROOT = Path(__file__).resolve().parents[3]


def experiment(*arguments: str) -> int:
    return main(["--stage", "experiment", *arguments])


@pytest.fixture(scope="session")
def smoke_tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tables 3.2, 4.5 and 4.6 at budget smoke, one seed."""
    out = tmp_path_factory.mktemp("experiments")
    assert experiment("--table", "4.5", "4.6", "3.2", "--budget", "smoke", "--seeds", "1", "--out", str(out)) == 0
    return out


def test_smoke_tables_are_written_with_numbers_and_verdicts(smoke_tables: Path) -> None:
    for name, rows in (("table_4.5", 11), ("table_4.6", 6), ("table_3.2", 6)):
        lines = (smoke_tables / f"{name}.csv").read_text().splitlines()[1:]
        filled = [line for line in lines if line.split(",")[3]]
        assert len(filled) >= 4 * rows
        assert "not comparable" in (text := (smoke_tables / f"{name}.md").read_text()) or "cannot be compared" in text
        assert "**holds**" in text or "**does not hold**" in text or "**undecided**" in text
        assert (smoke_tables / f"{name}.png").stat().st_size > 5000


def test_shared_rows_are_trained_once(smoke_tables: Path) -> None:
    # 11 rows of 4.5; 4.6 adds the one without colour; 3.2 adds 32 and 16 rows.
    assert len(list((smoke_tables / "runs").iterdir())) == 14


def test_the_result_says_whether_colour_and_sigma_are_alive(smoke_tables: Path) -> None:
    order = Order((), smoke_tables, "smoke", 1)
    from pipeline.experiments.chapter_4 import TWISE
    from pipeline.experiments.plan import runs_of

    run = runs_of(TWISE, order)[0]
    numbers = json.loads((run.folder(smoke_tables) / "result.json").read_text())["numbers"]
    assert {"alive/grey_mae_mm", "alive/sigma_spread", "edge/mae_mm", "hard/rmse_mm"} <= set(numbers)
    assert numbers["mae_mm"] == numbers["fused/mae_mm"] > 0


def test_equal_seeds_give_equal_tables(smoke_tables: Path, tmp_path: Path) -> None:
    (tmp_path / "data").symlink_to(smoke_tables / "data")
    assert experiment("--table", "4.6", "--budget", "smoke", "--seeds", "1", "--out", str(tmp_path)) == 0
    for suffix in (".md", ".csv", ".tex", ".png"):
        first, second = ((folder / f"table_4.6{suffix}").read_bytes() for folder in (smoke_tables, tmp_path))
        assert first == second, suffix


def test_a_killed_experiment_continues(smoke_tables: Path, tmp_path: Path) -> None:
    """SIGKILL in the middle of a training; the same command then gives what an uninterrupted run gives."""
    config = tmp_path / "long.yaml"
    config.write_text('table: "4.6"\nbudget: smoke\nseeds: 1\ncompletion: {steps: 12}\n')
    out = tmp_path / "out"
    (out / "data").mkdir(parents=True)
    (out / "data").rmdir()
    (out / "data").symlink_to(smoke_tables / "data")
    command = [
        sys.executable,
        "-m",
        "pipeline.cli",
        "--stage",
        "experiment",
        "--config",
        str(config),
        "--out",
        str(out),
    ]
    process = subprocess.Popen(
        command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 120
    while not list(out.glob("runs/*/state.safetensors")) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    whole = tmp_path / "whole"
    whole.mkdir()
    (whole / "data").symlink_to(smoke_tables / "data")
    for folder in (out, whole):
        assert experiment("--config", str(config), "--out", str(folder)) == 0
    assert (out / "table_4.6.csv").read_bytes() == (whole / "table_4.6.csv").read_bytes()


def test_a_dry_run_counts_and_writes_nothing(smoke_tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(smoke_tables.rglob("*"))
    arguments = ("--table", "4.5", "4.7", "--budget", "smoke", "--seeds", "1", "--out", str(smoke_tables))
    assert experiment(*arguments, "--dry-run", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["tables"] == {"Table 4.5": {"runs": 11, "left": 0}, "Table 4.7": {"runs": 6, "left": 5}}
    assert found["runs left"] == 5
    assert sorted(smoke_tables.rglob("*")) == before


def test_estimates_add_up_over_runs_and_count_data_once() -> None:
    from pipeline.experiments.catalogue import find

    order = Order((find("table", "4.7"),), Path("nowhere"), "small", 2)
    plan = make_plan(order)
    one, all_ = estimate_cost(plan.all_runs()[:1]), estimate_cost(plan.all_runs())
    assert len(plan.all_runs()) == 12
    assert one.seconds < all_.seconds < 12 * one.seconds


def test_a_damaged_result_is_named(tmp_path: Path) -> None:
    from pipeline.base.errors import UsageError
    from pipeline.experiments.chapter_2_3 import FIGURE_3_3

    recipe = FIGURE_3_3.rows[0].recipe
    assert recipe is not None
    run = plan_run(recipe, budget_of("analysis", "smoke"), None, 0)
    assert do_run(run, tmp_path, None).numbers["estimate_m"] == pytest.approx(5.5)
    (run.folder(tmp_path) / "result.json").write_text("{")
    with pytest.raises(UsageError, match="not the result of a run"):
        do_run(run, tmp_path, None)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("table: 4.5\n", "put the number in quotes"),
        ('table: "4.5"\nseed: 3\n', "unknown key 'seed'; did you mean 'seeds'"),
        ('table: "4.5"\nbudget: tiny\n', "budget: known: smoke, small, paper, got 'tiny'"),
        ("- 4.5\n", "expected 'section:' lines, got list"),
    ],
)
def test_a_wrong_configuration_is_named(tmp_path: Path, text: str, message: str) -> None:
    from pipeline.base.errors import UsageError

    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(UsageError, match=message):
        read_config(path)


def test_the_shipped_configurations_ask_for_their_table() -> None:
    files = sorted((ROOT / "configs" / "experiments").glob("*.yaml"))
    assert files
    for path in files:
        kind, _, number = path.stem.partition("-")
        assert (kind, number) in read_config(path).wanted


def test_a_request_that_cannot_be_carried_out(capsys: pytest.CaptureFixture[str]) -> None:
    assert experiment("--table", "4.55") == 2
    assert "did you mean '4.5'" in capsys.readouterr().err
    assert experiment("--table", "4.5", "--data", "nowhere") == 2
    assert "expected the folder of a data set" in capsys.readouterr().err


def test_the_list_names_every_experiment(capsys: pytest.CaptureFixture[str]) -> None:
    assert experiment("--list") == 0
    text = capsys.readouterr().out
    assert "Table 4.5" in text
    assert "TWISE is best in MAE and tMAE, L2 in RMSE" in text
    assert "listed only" in text
