"""Clouds of fewer rows for detector training: which rings they keep, that they are made once, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from detection.inputs import in_view_openpcdet
from pipeline.base.errors import UsageError
from pipeline.base.paths import RunFolder
from pipeline.data import open_dataset
from pipeline.geometry.rings import split_rings
from pipeline.run_folder.config import Config, parse_config
from pipeline.training.stage import CloudSamples, cloud_samples
from pipeline.training.thinned_clouds import ThinnedClouds
from tests.pipeline.tiny_kitti import write_tiny_kitti


def config(root: Path, **augment: object) -> Config:
    train = {"network": "detection", "beam_strides": [1, 4]}
    return parse_config({"data": {"name": "kitti_object", "root": str(root)}, "train": train, "augment": augment}, "t")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_tiny_kitti(tmp_path / "kitti", 3)


def test_every_frame_once_per_number_of_rows(root: Path, tmp_path: Path) -> None:
    dataset = open_dataset("kitti_object", root)
    clouds = cloud_samples(dataset, config(root, preset="L"), RunFolder(tmp_path / "run"))
    assert isinstance(clouds, ThinnedClouds)
    assert len(clouds) == 6
    whole, labels = clouds[1]
    thinned, _ = clouds[4]
    raw = dataset[1].points
    kept = raw[(split_rings(raw) % 4 == 0)]
    assert whole.id == thinned.id == "000001"
    assert labels[0].type == "Car"
    full_view = in_view_openpcdet(type(whole)(kept, whole.T_cam_velo, whole.P2, whole.image_size, "x"))
    np.testing.assert_array_equal(thinned.points, kept[full_view])
    assert 0.15 < len(thinned.points) / len(whole.points) < 0.35


def test_augmented_clouds_are_made_once(root: Path, tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    clouds = ThinnedClouds(open_dataset("kitti_object", root), config(root, preset="L_D_F"), run)
    first, _ = clouds[3]
    assert set(np.unique(first.points[:, 4])) == {0, 1}
    files = list((run.root / "training_clouds").rglob("*.npy"))
    assert [file.name for file in files] == ["000000-4.npy"]
    files[0].touch()
    stamp = files[0].stat().st_mtime_ns
    np.testing.assert_array_equal(clouds[3][0].points, first.points)
    assert files[0].stat().st_mtime_ns == stamp
    other = ThinnedClouds(open_dataset("kitti_object", root), config(root, preset="L_D_F", grid={"size": 0.8}), run)
    assert len(other[3][0].points) < len(first.points)


def test_masks_and_bad_steps_are_refused(root: Path, tmp_path: Path) -> None:
    dataset, run = open_dataset("kitti_object", root), RunFolder(tmp_path / "run")
    with pytest.raises(UsageError, match="object masks"):
        ThinnedClouds(dataset, config(root, preset="L_D_SF_mask", semantics="truth"), run)
    bad = config(root, preset="L")
    with pytest.raises(UsageError, match="beam_strides"):
        ThinnedClouds(
            dataset, bad.model_copy(update={"train": bad.train.model_copy(update={"beam_strides": (0,)})}), run
        )


def test_without_beam_strides_the_runs_own_clouds(root: Path, tmp_path: Path) -> None:
    plain = parse_config({"data": {"name": "kitti_object", "root": str(root)}}, "t")
    assert isinstance(cloud_samples(open_dataset("kitti_object", root), plain, RunFolder(tmp_path)), CloudSamples)
