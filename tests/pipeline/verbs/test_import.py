"""`--stage import`: weights into safetensors that load again, result pickles into KITTI lines."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from detection.kitti_format import parse_lines
from pipeline.cli import main

EMPTY = ("name", "alpha", "bbox", "dimensions", "location", "rotation_y", "score")


def run(path: Path, architecture: str, out: Path) -> int:
    return main(["--stage", "import", str(path), "--architecture", architecture, "--out", str(out)])


def test_results_of_openpcdet(tmp_path: Path) -> None:
    frames = [
        {
            "frame_id": "000007",
            "name": np.array(["Car"]),
            "truncated": np.zeros(1),
            "occluded": np.zeros(1),
            "alpha": np.array([0.1]),
            "bbox": np.array([[10, 20, 50, 60]], np.float32),
            "dimensions": np.array([[4.0, 1.5, 1.6]], np.float32),
            "location": np.array([[1, 1.7, 20]], np.float32),
            "rotation_y": np.array([0.25], np.float32),
            "score": np.array([0.9], np.float32),
        },
        {"frame_id": "000008", **dict.fromkeys(EMPTY, np.zeros((0, 3)))},
    ]
    (tmp_path / "result.pkl").write_bytes(pickle.dumps(frames))
    assert run(tmp_path / "result.pkl", "results", tmp_path / "out") == 0
    (item,) = parse_lines((tmp_path / "out" / "000007.txt").read_text(), scored=True)
    assert item.size == pytest.approx((1.5, 1.6, 4.0))
    assert item.location == pytest.approx((1, 1.7, 20))
    assert (item.ry, item.score) == pytest.approx((0.25, 0.9))
    assert (tmp_path / "out" / "000008.txt").read_text() == ""


def test_a_completion_checkpoint(tmp_path: Path) -> None:
    from completion.checkpoints import load_checkpoint
    from completion.models import build_model, default_spec

    model = build_model(default_spec("twise"))
    torch.save({"net": model.state_dict()}, tmp_path / "public.tar")
    assert run(tmp_path / "public.tar", "twise", tmp_path / "ours.safetensors") == 0
    ours, _ = load_checkpoint(tmp_path / "ours.safetensors")
    assert "public.tar" in (tmp_path / "ours.json").read_text()
    for name, tensor in model.state_dict().items():
        torch.testing.assert_close(ours.state_dict()[name], tensor, rtol=0, atol=0)


def test_a_detector_checkpoint(tmp_path: Path) -> None:
    from detection.checkpoints import load_checkpoint
    from detection.models.presets import pointrcnn

    model = pointrcnn().build()
    torch.save({"model_state": model.state_dict()}, tmp_path / "public.pth")
    assert run(tmp_path / "public.pth", "pointrcnn", tmp_path / "ours.safetensors") == 0
    ours, preset, card = load_checkpoint(tmp_path / "ours.safetensors")
    assert (preset.name, card["architecture"]) == ("pointrcnn", "pointrcnn")
    for name, tensor in model.state_dict().items():
        torch.testing.assert_close(ours.state_dict()[name], tensor, rtol=0, atol=0)


def test_wrong_requests(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "weights.pth"
    assert run(path, "twise", tmp_path / "a.safetensors") == 2
    path.write_bytes(b"nonsense")
    assert run(path, "resnet", tmp_path / "a.safetensors") == 2
    assert "known: twise" in capsys.readouterr().err
    assert run(path, "twise", tmp_path / "a.pth") == 2
    assert run(path, "twise", tmp_path / "a.safetensors") == 2
    assert run(path, "pointrcnn", tmp_path / "a.safetensors") == 2
    path.write_bytes(pickle.dumps({"frames": 1}))
    assert run(path, "results", tmp_path / "out") == 2
    assert "expected a list of frames" in capsys.readouterr().err
