"""The command line itself: help, refusals, damage, resume, shards, workers."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from pipeline.cli import main
from pipeline.data.kitti_object import read_velodyne, write_velodyne
from tests.pipeline.tiny_kitti import write_tiny_kitti

ROOT = Path(__file__).resolve().parents[2]
# Completed points on a grid and raw LiDAR: every step that needs no trained weights and no sigma.
AUGMENT = ("--config", "kitti", "--stage", "augment", "--set", "augment.preset=D", "--set", "augment.grid.size=0.2")


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return write_tiny_kitti(tmp_path / "kitti", 4)


def contents(run: Path) -> dict[str, bytes]:
    """Everything the frame stages wrote, by relative path; what a kill left behind under a hidden name is no result."""
    folders = ("depth", "twin", "cloud", "detections")
    files = (path for folder in folders for path in (run / folder).rglob("[!.]*") if path.is_file())
    return {path.relative_to(run).as_posix(): path.read_bytes() for path in files}


def test_help_answers_at_once_and_imports_nothing_heavy() -> None:
    code = (
        "import sys, time; start = time.perf_counter()\n"
        "from pipeline.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit as end: assert end.code == 0\n"
        "heavy = {'torch', 'open3d', 'numba', 'pydantic', 'numpy', 'cv2', 'matplotlib', 'scipy'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "assert time.perf_counter() - start < 0.5\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for name in ("synth", "train", "complete", "augment", "detect", "evaluate", "report", "examples:"):
        assert name in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--stage", "detekt"], "unknown stage 'detekt'; did you mean 'detect'?"),
        (["--config", "kitti"], "needs a folder: give --data DIR"),
        (["--config", "kitti", "--data", "/no/such/folder"], "no such folder: /no/such/folder"),
        (["--config", "nothing.yaml"], "no such configuration file: nothing.yaml"),
        (["--set", "seeed=3"], "unknown key seeed; did you mean 'seed'?"),
        (["--stage", "report", "--shard", "0/2"], "run --stage report once for all shards"),
        (["--stage", "synth", "--config", "kitti", "--data", "."], "--stage synth makes synthetic data"),
    ],
)
def test_what_cannot_be_carried_out_is_one_line_and_exit_code_2(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*arguments, "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("arguments", [["--shard", "2/2"], ["--shard", "x"], ["--workers", "0"], ["--nonsense"]])
def test_wrong_options_end_with_exit_code_2(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2


def test_settings_of_the_library_are_checked_before_any_frame(data: Path, tmp_path: Path, capsys) -> None:
    out = ["--data", str(data), "--out", str(tmp_path / "run"), "--config", "kitti", "--stage", "augment"]
    assert main([*out, "--set", "augment.preset=L_D_SX"]) == 2
    assert "did you mean 'L_D_SF'?" in capsys.readouterr().err
    assert main([*out, "--set", "augment.gird=null"]) == 2
    assert "unknown setting augment.gird; did you mean 'grid'?" in capsys.readouterr().err
    assert main([*out, "--set", "augment.preset=L_D_SF"]) == 2
    assert "needs object masks" in capsys.readouterr().err
    assert main([*out, "--set", "completion.model=twise9"]) == 2
    assert "no weights called 'twise9'" in capsys.readouterr().err
    assert not (tmp_path / "run" / "depth").exists()


def test_a_run_writes_its_files_and_is_not_repeated(data: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "run"
    command = [*AUGMENT, "--data", str(data), "--out", str(out), "--workers", "1"]
    assert main(command) == 0
    files = contents(out)
    names = {f"{folder}/{i:06d}.{end}" for i in range(4) for folder, end in (("depth", "png"), ("cloud", "bin"))}
    assert names <= set(files)
    cloud = np.frombuffer(files["cloud/000000.bin"], np.float32).reshape(-1, 5)
    assert set(np.unique(cloud[:, 4])) == {1.0}
    counts = json.loads(files["cloud/000000.json"])
    assert counts["points"] == len(cloud)
    assert [step["step"] for step in counts["steps"]][-2:] == ["grid_sampling", "join"]
    assert not (out / "failures.json").exists()
    times = {path: path.stat().st_mtime_ns for path in out.rglob("*.bin")}
    capsys.readouterr()
    assert main(["--stage", "augment", "--out", str(out)]) == 0  # the run's own configuration
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.bin")} == times


def done_frames(out: Path, stage: str) -> dict[str, float]:
    """Frame -> time it was finished, from all ledgers of a run."""
    found: dict[str, float] = {}
    for path in out.glob("ledger*.sqlite"):
        connection = sqlite3.connect(path)
        rows = connection.execute("SELECT frame, finished_at FROM done WHERE stage = ?", (stage,))
        found.update({frame: max(at, found.get(frame, 0.0)) for frame, at in rows})
        connection.close()
    return found


def test_a_change_redoes_exactly_what_depends_on_it(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    command = [*AUGMENT, "--data", str(data), "--out", str(out), "--workers", "1"]
    assert main(command) == 0
    before = {stage: done_frames(out, stage) for stage in ("complete", "augment")}
    # Another grid: augmentation only.
    assert main([*command, "--set", "augment.grid.size=0.4"]) == 0
    after = {stage: done_frames(out, stage) for stage in ("complete", "augment")}
    assert after["complete"] == before["complete"]
    assert all(after["augment"][frame] > before["augment"][frame] for frame in before["augment"])
    # Another cloud in one frame: that frame only.
    path = data / "training" / "velodyne" / "000002.bin"
    write_velodyne(path, read_velodyne(path)[::2])
    assert main([*command, "--set", "augment.grid.size=0.4"]) == 0
    again = done_frames(out, "complete")
    assert [frame for frame in sorted(again) if again[frame] != after["complete"][frame]] == ["000002"]
    # A result that was damaged: that result only.
    (out / "cloud" / "000001.bin").write_bytes(b"12345678901234567890")
    last = done_frames(out, "augment")
    assert main([*command, "--set", "augment.grid.size=0.4"]) == 0
    now = done_frames(out, "augment")
    assert [frame for frame in sorted(now) if now[frame] != last[frame]] == ["000001"]


def test_results_do_not_depend_on_workers_or_shards(data: Path, tmp_path: Path) -> None:
    one, two, shards = tmp_path / "one", tmp_path / "two", tmp_path / "shards"
    command = [*AUGMENT, "--data", str(data)]
    assert main([*command, "--out", str(one), "--workers", "1"]) == 0
    assert main([*command, "--out", str(two), "--workers", "2"]) == 0
    for index in (1, 0):
        assert main([*command, "--out", str(shards), "--workers", "1", "--shard", f"{index}/2"]) == 0
    assert contents(one) == contents(two) == contents(shards)
    assert sorted(path.name for path in shards.glob("ledger*")) == ["ledger-0-of-2.sqlite", "ledger-1-of-2.sqlite"]
    assert set(done_frames(shards, "augment")) == {f"{i:06d}" for i in range(4)}
    before = {path: path.stat().st_mtime_ns for path in shards.rglob("*.bin")}
    assert main([*command, "--out", str(shards), "--workers", "1"]) == 0  # sees what the shards did
    assert {path: path.stat().st_mtime_ns for path in shards.rglob("*.bin")} == before


def damage(data: Path) -> None:
    training = data / "training"
    (training / "velodyne" / "000001.bin").write_bytes(b"")
    image = training / "image_2" / "000002.png"
    image.write_bytes(image.read_bytes()[:5000])
    calibration = training / "calib" / "000003.txt"
    lines = calibration.read_text().splitlines(keepends=True)
    calibration.write_text("".join(line for line in lines if not line.startswith("P2")))


def test_damage_is_reported_and_other_frames_are_processed(data: Path, tmp_path: Path, capsys) -> None:
    clean = tmp_path / "clean"
    assert main([*AUGMENT, "--data", str(data), "--out", str(clean), "--workers", "1"]) == 0
    damage(data)
    out = tmp_path / "run"
    command = [*AUGMENT, "--data", str(data), "--out", str(out), "--workers", "1"]
    capsys.readouterr()
    assert main(command) == 1
    error = capsys.readouterr().err
    for line in (
        "velodyne/000001.bin: expected a velodyne cloud (float32 x y z intensity), got an empty file",
        "image_2/000002.png: expected a complete PNG image, got a file that ends after 5000 bytes",
        "calib/000003.txt: expected a line 'P2:', got P0, P1, P3",
    ):
        assert error.count(line) == 1
    failures = json.loads((out / "failures.json").read_text())
    assert failures["frames"] == ["000001", "000002", "000003"]
    assert failures["retry"].startswith("run_pipeline --config kitti --stage augment")
    assert {item["kind"] for item in failures["failures"]} == {"data"}
    assert contents(out) == {name: data for name, data in contents(clean).items() if "000000" in name}
    # Repaired data: only the failed frames are done, and nothing failed any more.
    write_tiny_kitti(data, 4)
    before = done_frames(out, "augment")
    assert main(command) == 0
    assert done_frames(out, "augment")["000000"] == before["000000"]
    assert contents(out) == contents(clean)
    assert not (out / "failures.json").exists()


def test_stop_at_the_first_failure_when_asked(data: Path, tmp_path: Path, capsys) -> None:
    (data / "training" / "velodyne" / "000000.bin").write_bytes(b"")
    command = [*AUGMENT, "--data", str(data), "--out", str(tmp_path / "run"), "--workers", "1"]
    assert main([*command, "--set", "run.keep_going=false"]) == 1
    assert "stopped at the first failure" in capsys.readouterr().err
    assert done_frames(tmp_path / "run", "complete") == {}


def test_frames_are_selected_by_positions_ids_and_split_files(data: Path, tmp_path: Path) -> None:
    (data / "ImageSets").mkdir()
    (data / "ImageSets" / "val.txt").write_text("000003\n")
    (tmp_path / "mine.txt").write_text("000000\n000002\n")
    chosen = {"1:3": {"000001", "000002"}, "000003,000000": {"000000", "000003"}, "val": {"000003"}}
    chosen[str(tmp_path / "mine.txt")] = {"000000", "000002"}
    for number, (frames, expected) in enumerate(chosen.items()):
        out = tmp_path / f"run{number}"
        command = [*AUGMENT, "--data", str(data), "--out", str(out), "--workers", "1", "--frames", frames]
        assert main(command) == 0
        assert {path.stem for path in (out / "cloud").glob("*.bin")} == expected


def test_a_disk_budget_stops_cleanly_and_the_run_continues(data: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "run"
    command = [*AUGMENT, "--data", str(data), "--out", str(out), "--workers", "1"]
    assert main([*command, "--set", "run.max_gb=0.000001"]) == 2  # no frame failed
    assert "disk budget of 1e-06 GB used up" in capsys.readouterr().err
    assert len(done_frames(out, "complete")) == 1
    assert main([*command, "--set", "run.keep_free_gb=1e9"]) == 2
    assert "are to be kept" in capsys.readouterr().err
    assert main(command) == 0
    assert len(done_frames(out, "augment")) == 4


@pytest.mark.parametrize("change", ["augment.preset=LDF", "augment.presett=L"])
def test_a_misspelt_preset_is_refused_before_anything_is_written(
    change: str, data: Path, tmp_path: Path, capsys
) -> None:
    options = ["--config", "kitti", "--data", str(data), "--out", str(tmp_path / "run"), "--set", change]
    for more in ([], ["--dry-run"]):
        assert main([*options, *more]) == 2
        assert "did you mean" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_dry_run_writes_nothing(data: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "run"
    command = [*AUGMENT, "--data", str(data), "--out", str(out), "--workers", "1"]
    assert main([*command, "--dry-run"]) == 0
    assert not out.exists()
    table = capsys.readouterr().out
    assert "complete" in table
    assert "default" in table
    assert main([*command, "--frames", "0:1"]) == 0
    capsys.readouterr()
    assert main([*command, "--dry-run"]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "complete" in line)
    assert row.split("│")[2].strip() == "3"  # one of four is done
    assert "measured" in row


def test_depth_from_a_folder_replaces_completion(data: Path, tmp_path: Path, capsys) -> None:
    from pipeline.data.depth_png import read_depth_png, write_depth_png

    depth = tmp_path / "depths"
    for i in range(3):  # the fourth frame has none
        true_depth = read_depth_png(data / "training" / "depth_2" / f"{i:06d}.png")
        # Frame 1 was predicted for the lower rows only, as many methods do; frame 2 is larger than its image.
        wrong = {1: true_depth[4:], 2: np.pad(true_depth, 1)}
        write_depth_png(depth / f"{i:06d}.png", wrong.get(i, true_depth))
    out = tmp_path / "run"
    command = [*AUGMENT, "--data", str(data), "--out", str(out), "--workers", "1", "--depth-from", str(depth)]
    command += ["--set", "augment.check_depth=false"]  # its true depth is not what its LiDAR measured
    assert main(command) == 1
    error = capsys.readouterr().err
    assert "depths/000002.png: expected" in error
    assert "50" in error
    assert "depths/000003.png: expected a 16-bit depth PNG, got no such file" in error
    assert {path.stem for path in (out / "cloud").glob("*.bin")} == {"000000", "000001"}
    assert not (out / "depth").exists()


@pytest.mark.parametrize("source", ["truth", "boxes", "files"])
def test_masks_come_from_the_source_that_is_asked_for(data: Path, tmp_path: Path, source: str) -> None:
    out = tmp_path / "run"
    if source == "files":
        source = f"files:{data / 'training' / 'semantic_2'}"
    options = ["--set", "augment.preset=L_D_SF", "--set", f"augment.semantics='{source}'"]
    options += ["--set", "augment.convention=cityscapes_trainIds"]
    command = ["--config", "kitti", "--stage", "augment", "--data", str(data), "--out", str(out), "--workers", "1"]
    assert main([*command, *options]) == 0
    steps = json.loads((out / "cloud" / "000000.json").read_text())["steps"]
    mask = next(step for step in steps if step["step"] == "semantic_mask")
    assert 0 < mask["out"] < mask["in"]


def start(command: list[str]) -> subprocess.Popen[str]:
    """The command line as a process of its own."""
    arguments = [sys.executable, "-m", "pipeline.cli", *command]
    return subprocess.Popen(arguments, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(run: Path, files: int, process: subprocess.Popen[str]) -> None:
    """Returns once the run has written `files` depth maps."""
    deadline = time.monotonic() + 60
    while len(list((run / "depth").glob("*.png"))) < files:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_killed_run_continues_and_ends_with_the_same_bytes(tmp_path: Path, workers: str) -> None:
    data = write_tiny_kitti(tmp_path / "kitti", 24)
    command = [*AUGMENT, "--data", str(data), "--workers", workers]
    assert main([*command, "--out", str(tmp_path / "whole")]) == 0
    out = tmp_path / "killed"
    process = start([*command, "--out", str(out)])
    wait_for(out, 5, process)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    before = done_frames(out, "complete")
    assert 1 <= len(before) < 24
    assert main([*command, "--out", str(out)]) == 0
    after = done_frames(out, "complete")
    assert {frame: after[frame] for frame in before} == before  # what the ledger had was not done again
    assert contents(out) == contents(tmp_path / "whole")


@pytest.mark.slow
def test_two_processes_on_one_folder_do_not_disturb_each_other(tmp_path: Path) -> None:
    data = write_tiny_kitti(tmp_path / "kitti", 8)
    command = [*AUGMENT, "--data", str(data), "--workers", "1"]
    assert main([*command, "--out", str(tmp_path / "alone")]) == 0
    out = tmp_path / "shared"
    processes = [start([*command, "--out", str(out)]) for _ in range(2)]
    for process in processes:
        _, error = process.communicate(timeout=100)
        assert process.returncode == 0, error
    assert contents(out) == contents(tmp_path / "alone")
    assert len(done_frames(out, "augment")) == 8


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_finishes_the_frame_in_hand_and_says_how_to_continue(tmp_path: Path, number: signal.Signals) -> None:
    data = write_tiny_kitti(tmp_path / "kitti", 24)
    out = tmp_path / "run"
    process = start([*AUGMENT, "--data", str(data), "--workers", "2", "--out", str(out)])
    wait_for(out, 2, process)
    process.send_signal(number)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert f"stopped by {number.name}; to continue: run_pipeline --config kitti" in error
    assert "Traceback" not in error
    finished = done_frames(out, "complete")
    assert {path.stem for path in (out / "depth").glob("*.png")} == set(finished)
    assert not list(out.rglob(".writing-*"))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder_is_one_line(data: Path, tmp_path: Path, capsys) -> None:
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    assert main([*AUGMENT, "--data", str(data), "--out", str(locked / "run")]) == 2
    assert "the run folder cannot be written" in capsys.readouterr().err


def test_an_interrupt_outside_the_batch_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    from pipeline import run

    def interrupted(_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "carry_out", interrupted)
    assert main([]) == 130
    assert capsys.readouterr().err == "run_pipeline: interrupted; the same command continues where it was\n"


@pytest.mark.parametrize("options", [["--stage", "evaluate", "--help"], ["--stage=check", "--help"]])
def test_verbs_have_their_own_help(options: list[str], capsys) -> None:
    with pytest.raises(SystemExit) as end:
        main(options)
    assert end.value.code == 0
    assert "usage: run_pipeline --stage" in capsys.readouterr().out


def test_json_says_how_a_run_went(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    words = ["--config", "kitti", "--data", str(data), "--out", str(out), "--stage", "complete", "--workers", "1"]
    words += ["--set", "completion.model=classical"]
    assert main([*words, "--dry-run", "--json"]) == 0
    (estimate,) = json.loads(capsys.readouterr().out)["estimates"]
    assert (estimate["stage"], estimate["measured"]) == ("complete", False)
    assert main([*words, "--json"]) == 0
    shown = capsys.readouterr()
    record = json.loads(shown.out)
    (stage,) = record["stages"]
    assert stage["done"] == stage["total"] == estimate["frames"]
    assert (record["exit_code"], record["run"], record["failures"]) == (0, str(out), None)
    assert "Frames" in shown.err
    assert main([*words, "--json", str(tmp_path / "result.json")]) == 0
    (again,) = json.loads((tmp_path / "result.json").read_text())["stages"]
    assert (again["done"], again["up_to_date"]) == (0, stage["total"])
    assert "Frames" in capsys.readouterr().out
