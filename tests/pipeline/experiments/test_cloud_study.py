"""The study of steps and noise on a street whose truth is known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.pointcloud_frame import street_frame
from pipeline.base.errors import DataError
from pipeline.experiments.cloud_study import StudyFrame, markdown_table, read_completed, study, sweep_figure
from pipeline.pointcloud.presets import AugmentSettings
from pipeline.pointcloud.sigma_filter import sigma_filter
from pipeline.pointcloud.taxonomy import CLEAN, NOISE_INBET, Taxonomy, label_noise


@pytest.fixture(scope="module")
def frame() -> StudyFrame:
    street = street_frame()
    ground = np.isclose(street.truth, street.truth.max(axis=1, keepdims=True))
    semantics = np.where((street.truth < 30) & ~ground, 13, 0).astype(np.uint8)
    return StudyFrame(street.completed, street.truth, semantics, street.points, street.calibration)


def test_the_table_counts_what_it_says(frame: StudyFrame) -> None:
    settings = AugmentSettings()
    rows, sweep = study([frame], settings, Taxonomy())
    labels = label_noise(frame.completed.depth, frame.truth, frame.semantics == 13, Taxonomy())
    first, filtered = rows["completed depth"], rows["+ sigma filter"]
    assert first["points"] == np.count_nonzero(frame.completed.depth)
    assert first["noise-inbet"] == np.count_nonzero(labels == NOISE_INBET)
    assert settings.sigma is not None
    kept = sigma_filter(frame.completed, settings.sigma)
    assert filtered["clean"] == np.count_nonzero(labels[kept] == CLEAN)
    assert filtered["noise-inbet"] == np.count_nonzero(labels[kept] == NOISE_INBET)
    assert first["object recall %"] == 100
    assert filtered["noise-inbet left %"] < first["noise-inbet left %"] == 100
    assert filtered["precision %"] > first["precision %"]
    assert rows["+ semantic mask"]["points"] < rows["+ context"]["points"] < rows["+ grid sampling"]["points"]
    removed, lost = sweep.shares()
    low, gap = 4, 5  # 0.2 and 3 m: the thesis's thresholds
    np.testing.assert_allclose(removed[low, gap], 100 - filtered["noise-inbet left %"])
    assert (np.diff(removed, axis=0) <= 0).all()
    assert (np.diff(lost, axis=1) <= 0).all()
    assert "The sigma filter removes" in markdown_table(rows)


def test_figure_is_written(frame: StudyFrame, tmp_path: Path) -> None:
    _, sweep = study([frame], AugmentSettings(), Taxonomy())
    path = sweep_figure(sweep, AugmentSettings(), tmp_path / "sweep.png")
    assert cv2.imread(str(path)).shape[0] > 300


def test_a_run_folder_is_read_with_its_surfaces(tmp_path: Path) -> None:
    (tmp_path / "depth").mkdir()
    (tmp_path / "twin").mkdir()
    cv2.imwrite(str(tmp_path / "depth" / "7.png"), np.full((3, 4), 2560, np.uint16))
    maps = {"foreground": np.full((3, 4), 2304, np.uint16), "background": np.full((3, 4), 2816, np.uint16)}
    np.savez(tmp_path / "twin" / "7.npz", sigma=np.full((3, 4), 51, np.uint8), **maps)
    completed = read_completed(tmp_path, "7", (3, 4))
    assert completed.foreground is not None
    assert completed.sigma is not None
    assert (completed.depth[0, 0], completed.foreground[0, 0]) == (10, 9)
    np.testing.assert_allclose(completed.sigma, 0.2, atol=1e-6)
    # The surfaces of a run are checked wherever they are read: sigma as floats is not what a run writes.
    np.savez(tmp_path / "twin" / "7.npz", sigma=np.full((3, 4), 0.2), **maps)
    with pytest.raises(DataError, match=r"uint8 sigma of shape \(3, 4\)"):
        read_completed(tmp_path, "7", (3, 4))
    (tmp_path / "twin" / "7.npz").unlink()
    for folder in (tmp_path, tmp_path / "depth"):
        one_surface = read_completed(folder, "7", (3, 4)).sigma
        assert one_surface is not None
        assert (one_surface == 1).all()
