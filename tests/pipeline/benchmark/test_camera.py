"""What the camera adds: sums over distance by hand, the table, the plot, and one method that looks at the picture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from completion.types import CompletedDepth
from pipeline.benchmark.camera import camera_table, distance_means, distance_sums, frame_pictures
from pipeline.benchmark.held_out_rings import HeldOutFrame, filled
from pipeline.cli import main
from pipeline.data import open_dataset
from tests.pipeline.tiny_kitti import write_tiny_kitti


def frame_of(truth: np.ndarray, edges: np.ndarray) -> HeldOutFrame:
    whole = np.ones(truth.shape, bool)
    return HeldOutFrame(np.zeros_like(truth), truth, truth, whole, edges, np.ones(len(edges), bool))


def test_sums_and_means_by_hand() -> None:
    truth = np.array([[5.0, 9.0, 0.0], [15.0, 85.0, 30.0]], np.float32)
    found = np.array([[5.25, 12.0, 7.0], [15.0, 80.0, 30.5]])
    frame = frame_of(truth, np.array([[0.0, 1, 9, 15], [1, 2, 15, 30]]))
    means = distance_means([distance_sums(found, frame), distance_sums(found, frame)])
    assert means["pixels"] == {
        "0-10": {"count": 4, "mae": pytest.approx(1625), "tmae": pytest.approx(625)},
        "10-20": {"count": 2, "mae": 0, "tmae": 0},
        "20-40": {"count": 2, "mae": pytest.approx(500), "tmae": pytest.approx(500)},
        "40-80": {"count": 0, "mae": None, "tmae": None},  # what lies further is in no bin
    }
    assert means["edges"]["0-10"] == {"count": 2, "mae": pytest.approx(3000), "tmae": pytest.approx(1000)}
    assert means["edges"]["10-20"]["count"] == 0
    np.testing.assert_array_equal(filled(np.array([[0.0, 0, 3], [0, 0, 0]])), np.full((2, 3), 3.0))


def test_every_frame_gets_a_picture_of_another(tmp_path: Path) -> None:
    dataset = open_dataset("kitti_object", write_tiny_kitti(tmp_path, 3))
    for number, other in ((0, 1), (1, 2), (2, 0)):
        found = frame_pictures(dataset, number)
        np.testing.assert_array_equal(found["true"], dataset[number].image)
        np.testing.assert_array_equal(found["other"], dataset[other].image)
        assert (found["grey"] == 128).all()
    alone = frame_pictures(dataset.select("0:1"), 0)
    np.testing.assert_array_equal(alone["other"], alone["true"][:, ::-1])


class Looks:
    """Answers with a depth that depends on nothing but the picture's mean."""

    def complete(self, sparse: np.ndarray, image: np.ndarray, K: object = None) -> CompletedDepth:
        return CompletedDepth(np.full(sparse.shape, image.mean() / 10, np.float32))


def test_bench_tries_three_pictures(streets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = f"{__name__}:Looks"
    options = ["--rows", "16", "--completers", f"nearest,{own}", "--detectors", "", "--masks", ""]
    assert main(["--stage", "bench", "--data", str(streets), "--out", str(tmp_path), *options]) == 0
    nearest, looks = json.loads((tmp_path / "real.json").read_text())["completion"]
    assert "pictures" not in nearest
    assert looks["pictures"]["true"]["mae"] == looks["mae"]
    assert len({found["mae"] for found in looks["pictures"].values()}) == 3
    table = camera_table([looks], 2)
    assert table[-1].startswith(f"| 16 | {own} | " + " / ".join(f"{p['mae']:.0f}" for p in looks["pictures"].values()))
    assert "\n".join(table) in capsys.readouterr().out
    counts = [entry["count"] for entry in looks["distance"]["grey"]["pixels"].values()]
    assert 0.9 * 2 * looks["pixels"] < sum(counts) <= 2 * looks["pixels"]
    assert (tmp_path / "camera.png").read_bytes()[:4] == b"\x89PNG"
