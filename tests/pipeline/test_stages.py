"""The stages together: detection with weights from a file, evaluation, report, training, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from detection.kitti_format import parse_lines
from pipeline.base.errors import UsageError
from pipeline.base.paths import RunFolder, safe_id
from pipeline.cli import main
from pipeline.run_folder.config import Config, load_config
from pipeline.stages.order import frame_stages_for
from tests.pipeline.tiny_kitti import write_tiny_kitti


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A detector of a few thousand parameters, untrained, as a weights file that the user names himself."""
    import torch

    from detection.checkpoints import save_checkpoint
    from detection.models.presets import small

    preset = small(points=512, width=0.25)
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_checkpoint(preset.build(), preset, path, {"data": "none: untrained, for tests"})
    return path


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_kitti(tmp_path_factory.mktemp("kitti"), 3)


def command(data: Path, weights: Path, out: Path, stage: str) -> list[str]:
    options = ["--config", "kitti", "--data", str(data), "--out", str(out), "--workers", "1", "--stage", stage]
    return [*options, "--set", f"detection.model={weights}"]


def test_from_frames_to_the_report(data: Path, weights: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "run"
    assert main(command(data, weights, out, "report")) == 0
    for name in ("000000", "000001", "000002"):
        for item in parse_lines((out / "detections" / f"{name}.txt").read_text(), scored=True):
            assert item.type in ("Car", "Pedestrian", "Cyclist")
    metrics = json.loads((out / "metrics.json").read_text())
    assert {row["metric"] for row in metrics["results"]} == {"2d", "aos", "bev", "3d"}
    assert metrics["frames"]["scored"] == ["000000", "000001", "000002"]
    assert [step["step"] for step in metrics["augmentation"]][-1] == "join"
    assert (out / "report" / "index.html").stat().st_size < 1_000_000
    assert (out / "tables.md").is_file()
    assert "report: " in capsys.readouterr().out
    resolved = load_config(out / "config.yaml")
    assert resolved.made_with is not None
    assert {"python", "torch", "git"} <= set(resolved.made_with)


def test_preset_l_detects_in_raw_lidar_and_completes_nothing(data: Path, weights: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert main([*command(data, weights, out, "detect"), "--set", "augment.preset=L"]) == 0
    assert len(list((out / "detections").glob("*.txt"))) == 3
    assert not (out / "depth").exists()
    assert not (out / "cloud").exists()


def test_back_to_raw_lidar_leaves_no_augmented_cloud(data: Path, weights: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert main(command(data, weights, out, "detect")) == 0
    assert len(list((out / "cloud").glob("*.bin"))) == 3
    assert main([*command(data, weights, out, "report"), "--set", "augment.preset=L"]) == 0
    assert not list((out / "cloud").iterdir())
    assert not json.loads((out / "metrics.json").read_text())["augmentation"]


def test_a_frame_without_label_is_detected_listed_and_not_scored(weights: Path, tmp_path: Path, capsys) -> None:
    data = write_tiny_kitti(tmp_path / "kitti", 2)
    (data / "training" / "label_2" / "000001.txt").unlink()
    out = tmp_path / "run"
    assert main([*command(data, weights, out, "evaluate"), "--set", "augment.preset=L"]) == 1
    assert "frame 000001: expected a label file, got none" in capsys.readouterr().err
    assert (out / "detections" / "000001.txt").is_file()
    (failure,) = json.loads((out / "failures.json").read_text())["failures"]
    assert (failure["stage"], failure["frame"]) == ("evaluate", "000001")
    assert json.loads((out / "metrics.json").read_text())["frames"]["scored"] == ["000000"]


def test_a_data_set_without_any_label_cannot_be_evaluated(weights: Path, tmp_path: Path, capsys) -> None:
    data = write_tiny_kitti(tmp_path / "kitti", 1)
    for folder in ("label_2", "depth_2"):
        (data / "training" / folder / ("000000.txt" if folder == "label_2" else "000000.png")).unlink()
    out = tmp_path / "run"
    assert main([*command(data, weights, out, "evaluate"), "--set", "augment.preset=L"]) == 2
    assert "no frame has labels or true depth" in capsys.readouterr().err
    assert main([*command(data, weights, out, "report"), "--set", "augment.preset=L"]) == 0


def test_a_random_network_is_never_used_silently(data: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    from pipeline.run_folder import weights as bundled

    monkeypatch.setattr(bundled, "bundled_names", lambda room: [])
    options = ["--config", "kitti", "--data", str(data), "--out", str(tmp_path / "run"), "--stage", "detect"]
    assert main([*options, "--set", "detection.model=auto"]) == 2
    assert "a network with random weights is never used" in capsys.readouterr().err
    assert not (tmp_path / "run" / "detections").exists()


def test_damaged_weights_refuse_the_run(data: Path, weights: Path, tmp_path: Path, capsys) -> None:
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(weights.read_bytes()[:-100])
    bad.with_suffix(".json").write_bytes(weights.with_suffix(".json").read_bytes())
    options = command(data, bad, tmp_path / "run", "detect")
    assert main([*options, "--set", "augment.preset=L"]) == 2
    assert "bad.safetensors" in capsys.readouterr().err
    assert not (tmp_path / "run" / "detections").exists()


@pytest.mark.slow
def test_the_demo_makes_its_own_data_once(weights: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "demo"
    options = ["--out", str(out), "--workers", "1", "--set", "synth.frames=2", "--set", "synth.size=[94, 310]"]
    options += ["--set", f"detection.model={weights}"]
    assert main(options) == 0
    assert len(list((out / "data" / "training" / "velodyne").glob("*.bin"))) == 2
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["depth"]["frames"] == 2
    assert len(metrics["frames"]["scored"]) == 2
    assert "Points per augmentation step" in (out / "report" / "index.html").read_text()
    before = {path: path.stat().st_mtime_ns for path in (out / "data").rglob("*") if path.is_file()}
    assert main(options) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "data").rglob("*") if path.is_file()} == before
    # Fewer frames: the run's own folder holds exactly what is asked for.
    assert main([*options, "--set", "synth.frames=1", "--stage", "synth"]) == 0
    assert len(list((out / "data" / "training" / "velodyne").glob("*.bin"))) == 1
    capsys.readouterr()
    assert main([*options, "--set", "synth.fraems=1"]) == 2
    assert "unknown setting synth.fraems; did you mean 'frames'?" in capsys.readouterr().err


def test_synthetic_data_is_never_written_into_a_folder_of_the_users(tmp_path: Path, capsys) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("three years of work")
    assert main(["--stage", "synth", "--data", str(mine), "--out", str(tmp_path / "run")]) == 2
    assert "holds files that the synth stage did not write" in capsys.readouterr().err
    assert [path.name for path in mine.iterdir()] == ["thesis.txt"]


@pytest.mark.slow
def test_training_segmentation_gives_weights_that_mask(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    options = ["--config", "kitti", "--data", str(data), "--out", str(out), "--workers", "1"]
    options += ["--set", "train.network=segmentation", "--set", "train.steps=1", "--set", "train.batch_size=1"]
    assert main([*options, "--set", "train.crop=[32, 64]", "--stage", "train"]) == 0
    weights = out / "weights" / "segmentation" / "last.safetensors"
    masks = ["--set", "augment.preset=L_D_SF", "--set", f"augment.semantics=network:{weights}", "--stage", "augment"]
    assert main([*options[:8], *masks]) == 0
    steps = json.loads((out / "cloud" / "000000.json").read_text())["steps"]
    assert "semantic_mask" in [step["step"] for step in steps]


@pytest.mark.slow
def test_training_a_detector_gives_weights_that_detect(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    options = ["--config", "kitti", "--data", str(data), "--out", str(out), "--workers", "1"]
    options += ["--set", "augment.preset=L", "--set", "train.network=detection", "--set", "train.steps=1"]
    options += ["--set", "train.options={points: 512, width: 0.25}", "--set", "train.batch_size=1"]
    assert main([*options, "--stage", "train"]) == 0
    weights = out / "weights" / "detection" / "last.safetensors"
    assert main([*options, "--stage", "detect", "--set", f"detection.model={weights}"]) == 0
    assert len(list((out / "detections").glob("*.txt"))) == 3


@pytest.mark.slow
def test_training_completion_gives_weights_that_complete(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    options = ["--config", "kitti", "--data", str(data), "--out", str(out), "--workers", "1"]
    options += ["--set", "train.max_steps=1", "--set", "train.accumulate=1"]
    options += ["--set", "train.model.arguments.channels=4"]
    assert main([*options, "--stage", "train"]) == 0
    (weights,) = (out / "weights" / "completion").glob("last.safetensors")
    assert main([*options, "--stage", "augment", "--set", f"completion.model={weights}"]) == 0
    assert len(list((out / "twin").glob("*.npz"))) == 3


@pytest.mark.parametrize(
    ("stage", "changes", "has_points", "expected"),
    [
        ("complete", {}, True, ["complete"]),
        ("augment", {}, True, ["complete", "augment"]),
        ("report", {}, True, ["complete", "augment", "detect"]),
        ("detect", {"augment": {"preset": "L"}}, True, ["detect"]),
        ("augment", {"augment": {"preset": "L"}}, True, ["complete", "augment"]),
        ("detect", {"augment": {"depth_from": "x"}}, True, ["augment", "detect"]),
        ("evaluate", {}, False, ["complete"]),
        ("synth", {}, True, []),
        ("train", {}, True, []),
        ("train", {"train": {"network": "detection"}}, True, ["complete", "augment"]),
        ("train", {"train": {"network": "detection"}, "augment": {"preset": "L"}}, True, []),
    ],
)
def test_a_stage_runs_what_it_needs_and_nothing_after(stage, changes, has_points, expected) -> None:
    assert frame_stages_for(stage, Config.model_validate(changes), has_points) == expected


def test_sparse_depth_of_labelled_frames_serves_as_lidar() -> None:
    from pipeline.data import Dataset, Frame
    from pipeline.run_folder.frames import has_points
    from pipeline.stages.clouds import lidar_of
    from tests.pipeline.tiny_kitti import CALIBRATION

    sparse = np.zeros((48, 96), np.float32)
    sparse[30, 50], sparse[40, 20] = 10.0, 5.0
    loaders = {"sparse_depth": lambda: sparse, "calibration": lambda: CALIBRATION}
    indoor = Frame("1", loaders)
    street = Frame("1", {**loaders, "labels": lambda: []})
    assert not has_points(Dataset(("1",), lambda _: indoor))
    assert has_points(Dataset(("1",), lambda _: street))
    points = lidar_of(street)
    assert points.shape == (2, 4)
    pixels, depth = CALIBRATION.cam_to_image(CALIBRATION.velo_to_cam(points))
    # Back-projection leaves out the last row of P2 (3 mm here), projection does not.
    np.testing.assert_allclose(pixels, [[50, 30], [20, 40]], atol=0.05)
    np.testing.assert_allclose(depth, [10, 5], rtol=1e-6)


def test_detection_needs_points() -> None:
    with pytest.raises(UsageError, match="needs LiDAR points"):
        frame_stages_for("detect", Config(), has_points=False)


@pytest.mark.parametrize("name", ["../x", "/etc/passwd", "a/../../b", "", "a\\b", "a//b", "./a", "a\nb"])
def test_frame_ids_do_not_lead_out_of_the_run(name: str) -> None:
    with pytest.raises(UsageError, match="cannot be used as a file name"):
        RunFolder(Path("run")).depth(name)


def test_frame_ids_with_folders_are_kept() -> None:
    assert safe_id("Scene01/clone/Camera_0/00001") == "Scene01/clone/Camera_0/00001"
    assert RunFolder(Path("run")).cloud("Scene01/1") == Path("run/cloud/Scene01/1.bin")
