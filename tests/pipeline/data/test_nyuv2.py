"""NYU Depth v2: three containers, the 304 x 208 protocol, 500 seeded samples."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.base.errors import DataError, UsageError
from pipeline.data import open_dataset
from pipeline.data.nyuv2 import open_nyuv2, open_nyuv2_full, sample_depth
from pipeline.experiments.frames import open_any

h5py = pytest.importorskip("h5py")


@pytest.fixture
def scene(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(480, 640, 3) image and (480, 640) depth in metres."""
    image = rng.integers(0, 255, (480, 640, 3), dtype=np.uint8)
    depth = rng.uniform(1, 9, (480, 640)).astype(np.float32)
    depth[:, :100] = 0
    return image, depth


def test_labelled_mat(tmp_path: Path, scene: tuple[np.ndarray, np.ndarray]) -> None:
    image, depth = scene
    with h5py.File(tmp_path / "nyu_depth_v2_labeled.mat", "w") as file:
        file["images"] = image.transpose(2, 1, 0)[None]
        file["depths"] = depth.T[None]
    (frame,) = open_nyuv2_full(tmp_path)
    np.testing.assert_array_equal(frame.image, image)
    np.testing.assert_array_equal(frame.target_depth, depth)


def test_a_labelled_mat_that_is_no_hdf5_is_named(tmp_path: Path) -> None:
    (tmp_path / "nyu_depth_v2_labeled.mat").write_bytes(b"MATLAB 5.0 MAT-file")
    with pytest.raises(DataError, match=r"nyu_depth_v2_labeled.mat: expected an HDF5 file"):
        open_nyuv2_full(tmp_path)


def test_h5_tree(tmp_path: Path, scene: tuple[np.ndarray, np.ndarray]) -> None:
    image, depth = scene
    (tmp_path / "val" / "kitchen").mkdir(parents=True)
    with h5py.File(tmp_path / "val" / "kitchen" / "00001.h5", "w") as file:
        file["rgb"] = image.transpose(2, 0, 1)
        file["depth"] = depth
    dataset = open_nyuv2_full(tmp_path)
    assert dataset.ids == ("val/kitchen/00001",)
    np.testing.assert_array_equal(dataset[0].image, image)
    np.testing.assert_array_equal(dataset[0].target_depth, depth)


def test_protocol(tmp_path: Path, scene: tuple[np.ndarray, np.ndarray]) -> None:
    image, depth = scene
    (tmp_path / "frame").mkdir()
    cv2.imwrite(str(tmp_path / "frame" / "rgb.png"), image[:, :, ::-1])
    cv2.imwrite(str(tmp_path / "frame" / "depth.png"), np.rint(1000 * depth).astype(np.uint16))
    (frame,) = open_dataset("nyuv2", tmp_path)
    assert frame.image.shape == (208, 304, 3)
    # Half of 480 x 640 is 240 x 320; the crop's corner is (16, 8) there, (32, 16) in the full image.
    np.testing.assert_allclose(frame.target_depth[0, 0], depth[32, 16], atol=5e-4)
    np.testing.assert_allclose(frame.target_depth[-1, -1], depth[32 + 414, 16 + 606], atol=5e-4)
    assert frame.image[0, 0, 0] == pytest.approx(image[32:34, 16:18, 0].mean(), abs=1)
    assert frame.calibration.K[0, 2] == pytest.approx(325.582449 / 2 - 8)
    assert frame.calibration.K[1, 2] == pytest.approx(253.736166 / 2 - 16)
    sparse = frame.sparse_depth
    assert (sparse > 0).sum() == 500
    np.testing.assert_array_equal(sparse[sparse > 0], frame.target_depth[sparse > 0])
    assert not sparse[frame.target_depth == 0].any()


def test_samples_depend_on_seed_and_frame_only() -> None:
    target = np.full((30, 40), 2.0, np.float32)
    first = sample_depth(target, 50, 0, "a")
    np.testing.assert_array_equal(first, sample_depth(target, 50, 0, "a"))
    assert (first != sample_depth(target, 50, 0, "b")).any()
    assert (first != sample_depth(target, 50, 1, "a")).any()
    assert (sample_depth(target, 5000, 0, "a") == target).all()


def test_the_real_frames(nyu: Path) -> None:
    dataset = open_nyuv2(nyu)
    assert len(dataset) == 2
    for frame in dataset:
        assert 0.3 < frame.target_depth[frame.target_depth > 0].min() < frame.target_depth.max() < 10
        assert (frame.sparse_depth > 0).sum() == 500


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no NYU Depth v2 frame"):
        open_nyuv2(tmp_path)


def test_folders_of_frames_may_stand_in_folders(tmp_path: Path, scene: tuple[np.ndarray, np.ndarray]) -> None:
    image, depth = scene
    for name in ("train/kitchen/00001", "val/kitchen/00001"):
        (tmp_path / name).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / name / "rgb.png"), image[:, :, ::-1])
        cv2.imwrite(str(tmp_path / name / "depth.png"), np.rint(1000 * depth).astype(np.uint16))
    dataset = open_any(tmp_path)
    assert (dataset.name, dataset.ids) == ("nyuv2", ("train/kitchen/00001", "val/kitchen/00001"))
    np.testing.assert_array_equal(dataset[1].image[0, 0], dataset[0].image[0, 0])
    assert dataset[1].target_depth.shape == (208, 304)
