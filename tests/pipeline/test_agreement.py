"""Check, augment, detect, evaluate and export agree on which frames a messy folder has, and why one has none."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from detection.kitti_format import format_line
from pipeline.base.paths import RunFolder
from pipeline.cli import main
from pipeline.run_folder.config import load_config
from pipeline.run_folder.frames import open_frames
from tests.pipeline.tiny_kitti import tiny_frame, write_tiny_kitti

FRAMES = ("000000", "000001", "000002", "000003")
AUGMENT = ("--config", "kitti", "--stage", "augment", "--set", "completion.model=classical", "--workers", "1")


def messy(root: Path) -> Path:
    """Four frames under odd names, what systems leave behind, a label of no frame, and one cloud of five columns."""
    training = write_tiny_kitti(root, 4) / "training"
    (training / "image_2").rename(training / "image_02")
    for index, path in enumerate(sorted((training / "label_2").iterdir())):
        path.rename(path.with_name(f"{index}.TXT"))
    path = training / "calib" / "000001.txt"
    path.write_bytes(path.read_text().replace("\n", "\r\n").encode("utf-16"))
    (training / "image_02" / "Thumbs.db").write_bytes(b"x")
    (training / "velodyne" / "._000000.bin").write_bytes(b"x")
    (training / "label_2" / "000077.txt").write_text("")
    cloud = tiny_frame(3).points
    five = np.column_stack([cloud, np.repeat(np.arange(16), len(cloud) // 16)]).astype("<f4")
    (training / "velodyne" / "000003.bin").write_bytes(five.tobytes())
    return root


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return messy(tmp_path / "kitti")


def test_runs_the_doctor_and_exports_see_the_same_frames_and_the_same_reason(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reason = "5 float32 columns a point"
    assert main(["--stage", "check", str(root), "--workers", "1", "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["frames"] == len(FRAMES)
    assert [f["frame"] for f in report["findings"] if f["fault"] == "wrong_columns"] == ["000003"]
    assert [f["frame"] for f in report["findings"] if f["fault"] == "extra_file"] == ["000077"]
    assert all(reason in f["message"] for f in report["findings"] if f["fault"] == "wrong_columns")

    run = tmp_path / "run"
    assert main([*AUGMENT, "--data", str(root), "--out", str(run)]) == 1
    assert "files are named otherwise than their frames" in capsys.readouterr().err
    assert sorted(path.stem for path in (run / "cloud").glob("*.bin")) == list(FRAMES[:3])
    failures = json.loads((run / "failures.json").read_text())["failures"]
    assert {failure["frame"] for failure in failures} == {"000003"}
    assert reason in failures[0]["found"]
    config = load_config("kitti", [f"data.root={root}"])
    assert open_frames(config, RunFolder(run)).ids == FRAMES  # what detect, evaluate and report go through

    out = tmp_path / "out"
    assert (
        main(["--stage", "export", "--format", "kitti_bin", "--data", str(root), "--out", str(out), "--workers", "1"])
        == 1
    )
    assert sorted(path.stem for path in (out / "velodyne").glob("*.bin")) == list(FRAMES[:3])
    assert reason in json.dumps(json.loads((out / "failures.json").read_text()))


def test_the_evaluator_sees_the_labels_of_the_same_frames(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    detections, labels = tmp_path / "detections", root / "training" / "label_2"
    detections.mkdir()
    for index, frame in enumerate(FRAMES):
        (detections / f"{frame}.txt").write_text(format_line(tiny_frame(index).labels[0]) + " 0.9\n")
    (labels / "000077.txt").unlink()
    request = ["--stage", "evaluate", "--labels", str(labels), "--detections", str(detections), "--classes", "Car"]
    assert main([*request, "--json", "-"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["protocol"]["frames"] == record["protocol"]["detections"] == len(FRAMES)


def test_a_folder_of_clouds_of_five_columns_ends_with_one_line_and_is_read_when_they_are_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_tiny_kitti(tmp_path / "kitti", 2)
    for index in range(2):
        cloud = tiny_frame(index).points
        five = np.column_stack([cloud, np.zeros(len(cloud))]).astype("<f4")
        (root / "training" / "velodyne" / f"{index:06d}.bin").write_bytes(five.tobytes())
    run, out = tmp_path / "run", tmp_path / "out"
    export = ["--stage", "export", "--format", "kitti_bin", "--data", str(root), "--out", str(out), "--workers", "1"]
    for command in ([*AUGMENT, "--data", str(root), "--out", str(run)], export):
        assert main(command) == 2
        error = capsys.readouterr().err
        assert "its clouds have 5; set data.columns=5" in error
        assert error.count("\n") == 1
    assert main([*AUGMENT, "--data", str(root), "--out", str(run), "--set", "data.columns=5"]) == 0
    assert main([*export, "--columns", "5"]) == 0
    written = np.fromfile(out / "velodyne" / "000001.bin", "<f4").reshape(-1, 4)
    np.testing.assert_array_equal(written, tiny_frame(1).points)
