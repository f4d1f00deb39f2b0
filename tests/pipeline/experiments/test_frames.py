"""Frames of the user's own data sets, as the completion experiments store them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.base.errors import UsageError
from pipeline.cli import main
from pipeline.data import open_dataset
from pipeline.experiments.budgets import COMPLETION, CompletionBudget
from pipeline.experiments.frames import ROWS, StoredFrame, ensure_frames, load, open_any
from tests.pipeline.data.vkitti2_tree import write_tree

# Whole images, so that stored maps can be compared with those of the data set.
BUDGET = replace(COMPLETION["smoke"], size=None, test_rows=0, test_columns=0)


@pytest.fixture(scope="module")
def streets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four small synthetic frames in KITTI object's layout with depth_2."""
    out = tmp_path_factory.mktemp("streets")
    changes = ["synth.frames=4", "synth.size=[96, 320]"]
    settings = [part for change in changes for part in ("--set", change)]
    assert main(["--stage", "synth", "--out", str(out), *settings]) == 0
    return out / "data"


def _frames(root: Path, out: Path, budget: CompletionBudget = BUDGET) -> list[StoredFrame]:
    train, test = ensure_frames(out, root, budget, lambda text: None)
    assert not {path.name for path in train} & {path.name for path in test}
    return [load(path) for path in (*train, *test)]


def test_frames_of_kitti_object(streets: Path, tmp_path: Path) -> None:
    found = _frames(streets, tmp_path)
    dataset = open_dataset("kitti_object", streets)
    # Three quarters train, of which two are asked for; the last quarter tests.
    assert len(found) == 3
    frame = dataset[dataset.ids[3]]
    stored = found[2]
    np.testing.assert_array_equal(stored.image, frame.image)
    np.testing.assert_allclose(stored.sparse[64], frame.sparse_depth, atol=1 / 512 + 1e-6)
    known = stored.clean > 0
    np.testing.assert_allclose(stored.clean[known], frame.target_depth[known], atol=1 / 512 + 1e-6)
    counts = [(stored.sparse[rows] > 0).sum() for rows in ROWS]
    assert counts[0] > 1.7 * counts[1] > 1.7 * 1.7 * counts[2]
    assert stored.semi_dense is None


def test_prepared_frames_are_not_made_again(streets: Path, tmp_path: Path) -> None:
    train, _ = ensure_frames(tmp_path, streets, BUDGET, lambda text: None)
    before = train[0].stat().st_mtime_ns
    train[1].unlink()
    again, _ = ensure_frames(tmp_path, streets, BUDGET, lambda text: None)
    assert again[0].stat().st_mtime_ns == before
    assert again[1].is_file()


def test_frames_of_virtual_kitti_2_from_one_scene(tmp_path: Path) -> None:
    # Two cameras of two moments; scans are drawn from the true depth.
    root = write_tree(tmp_path / "vkitti2", "Scene01", 2)
    first, *_, last = _frames(root, tmp_path / "out")
    assert (first.clean > 0).sum() > 10 * (first.sparse[64] > 0).sum() > 0
    assert not np.array_equal(first.clean, last.clean)


def test_frames_of_nyu(tmp_path: Path, rng: np.random.Generator) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "nyu_depth_v2_labeled.mat", "w") as file:
        file["images"] = rng.integers(0, 255, (4, 3, 640, 480), dtype=np.uint8)
        file["depths"] = rng.uniform(1, 5, (4, 640, 480)).astype(np.float32)
    found = _frames(tmp_path, tmp_path / "out")
    assert [frame.image.shape for frame in found] == [found[0].image.shape] * 3
    assert all(frame.clean[frame.clean > 0].min() > 0.9 and frame.clean.max() < 5.1 for frame in found)


def test_a_folder_without_true_depth_is_refused(tmp_path: Path, streets: Path) -> None:
    with pytest.raises(UsageError, match="expected a data set with true depth"):
        open_any(tmp_path)
    with pytest.raises(UsageError, match="synthetic world only"):
        ensure_frames(tmp_path, streets, BUDGET, lambda text: None, ("train",))


def test_a_figure_from_the_users_data(streets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--figure", "4.9", "--budget", "smoke", "--seeds", "1", "--data", str(streets), "--out", str(tmp_path)]
    assert main(["--stage", "experiment", *arguments]) == 0
    table = (tmp_path / "figure_4.9.md").read_text()
    assert "Data: data." in table  # the name of the folder
    assert len([line for line in table.splitlines() if line.startswith(("| MultiStack |", "| TWISE |"))]) == 2
