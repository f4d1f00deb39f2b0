"""KITTI object reader and writer: round trips, real frames, and one clear line for every kind of damage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from detection.kitti_format import KittiObject
from pipeline.base.errors import DataError, MissingPart, UsageError
from pipeline.data import open_dataset
from pipeline.data.frame import Frame
from pipeline.data.kitti_object import read_labels, read_velodyne, write_frame, write_objects, write_velodyne
from pipeline.geometry.calibration import Calibration

P2 = np.array([[100.0, 0, 40, 3], [0, 100, 20, 0.5], [0, 0, 1, 0.003]])
# x forward, y left, z up -> x right, y down, z forward, 8 cm behind and 27 cm above the camera
T_CAM0_VELO = np.array([[0, -1.0, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])
CALIBRATION = Calibration(P2=P2, R0_rect=np.eye(3), T_cam0_velo=T_CAM0_VELO)
CAR = KittiObject("Car", 0.0, 0, -1.57, (10.0, 5.0, 30.0, 25.0), (1.5, 1.6, 3.9), (1.0, 1.6, 12.0), 0.25)


def make_frame(frame_id: str, rng: np.random.Generator) -> Frame:
    image = rng.integers(0, 255, (40, 80, 3), dtype=np.uint8)
    points = rng.uniform(0, 30, (50, 4)).astype(np.float32)
    depth = (rng.integers(0, 65535, (40, 80)) / 256).astype(np.float32)
    labels = rng.integers(0, 19, (40, 80), dtype=np.uint8)
    instances = rng.integers(0, 400, (40, 80), dtype=np.int32)
    return Frame(
        frame_id,
        {
            "image": lambda: image,
            "points": lambda: points,
            "calibration": lambda: CALIBRATION,
            "labels": lambda: [CAR],
            "target_depth": lambda: depth,
            "semantics": lambda: labels,
            "instances": lambda: instances,
        },
    )


@pytest.fixture
def root(tmp_path: Path, rng: np.random.Generator) -> Path:
    for index in range(3):
        write_frame(tmp_path / "training", make_frame(f"{index:06d}", rng))
    return tmp_path


def test_a_written_frame_is_read_back_exactly(tmp_path: Path, rng: np.random.Generator) -> None:
    frame = make_frame("000007", rng)
    write_frame(tmp_path / "training", frame)
    read = open_dataset("kitti_object", tmp_path)["000007"]
    np.testing.assert_array_equal(read.image, frame.image)
    np.testing.assert_array_equal(read.points, frame.points)
    np.testing.assert_array_equal(read.target_depth, frame.target_depth)
    np.testing.assert_array_equal(read.semantics, frame.semantics)
    np.testing.assert_array_equal(read.instances, frame.instances)
    np.testing.assert_allclose(read.calibration.P2, P2, rtol=1e-12)
    np.testing.assert_allclose(read.calibration.T_cam_velo, T_CAM0_VELO, rtol=1e-12)
    assert read.labels == [CAR]
    assert read.image_size == (40, 80)


def test_the_split_folder_itself_is_taken_too(root: Path) -> None:
    assert open_dataset("kitti_object", root / "training").ids == ("000000", "000001", "000002")


def test_a_part_names_the_files_it_is_read_from(root: Path) -> None:
    frame = open_dataset("kitti_object", root)["000001"]
    assert frame.files("points") == (root / "training" / "velodyne" / "000001.bin",)
    assert frame.files("sparse_depth") == ()


def test_jpeg_images_are_found(root: Path) -> None:
    import cv2

    folder = root / "training" / "image_2"
    image = cv2.imread(str(folder / "000000.png"))
    cv2.imwrite(str(folder / "000000.jpg"), image)
    (folder / "000000.png").unlink()
    frame = open_dataset("kitti_object", root)["000000"]
    assert frame.image.shape == (40, 80, 3)
    assert frame.image_size == (40, 80)


def test_no_such_folder_and_no_frames(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no such folder: .*nowhere"):
        open_dataset("kitti_object", tmp_path / "nowhere")
    with pytest.raises(UsageError, match="expected training/"):
        open_dataset("kitti_object", tmp_path)
    (tmp_path / "training" / "image_2").mkdir(parents=True)
    with pytest.raises(UsageError, match="no frame found"):
        open_dataset("kitti_object", tmp_path)
    with pytest.raises(UsageError, match="unknown data set 'kiti'"):
        open_dataset("kiti", tmp_path)


def damage_empty_cloud(folder: Path) -> None:
    (folder / "velodyne" / "000001.bin").write_bytes(b"")


def damage_cut_cloud(folder: Path) -> None:
    path = folder / "velodyne" / "000001.bin"
    path.write_bytes(path.read_bytes()[:-3])


def damage_nan_cloud(folder: Path) -> None:
    points = read_velodyne(folder / "velodyne" / "000001.bin").copy()
    points[4, 1] = np.nan
    write_velodyne(folder / "velodyne" / "000001.bin", points)


def damage_huge_cloud(folder: Path) -> None:
    points = read_velodyne(folder / "velodyne" / "000001.bin").copy()
    points[4, 1] = 1e9
    write_velodyne(folder / "velodyne" / "000001.bin", points)


def damage_missing_cloud(folder: Path) -> None:
    (folder / "velodyne" / "000001.bin").unlink()


def damage_cut_image(folder: Path) -> None:
    path = folder / "image_2" / "000001.png"
    path.write_bytes(path.read_bytes()[:3000])


def damage_flipped_image(folder: Path) -> None:
    path = folder / "image_2" / "000001.png"
    data = bytearray(path.read_bytes())
    data[2000] ^= 0xFF
    path.write_bytes(bytes(data))


def damage_text_image(folder: Path) -> None:
    (folder / "image_2" / "000001.png").write_text("not an image")


def damage_calibration(folder: Path) -> None:
    path = folder / "calib" / "000001.txt"
    path.write_text("".join(line + "\n" for line in path.read_text().splitlines() if not line.startswith("P2")))


def damage_label(folder: Path) -> None:
    (folder / "label_2" / "000001.txt").write_text("Car 0.00 0 x 1 2 3 4 5 6 7 8 9 10 11\n")


def damage_depth(folder: Path) -> None:
    import cv2

    cv2.imwrite(str(folder / "depth_2" / "000001.png"), np.ones((40, 80), np.uint8))


@pytest.mark.parametrize(
    ("damage", "part", "file", "found"),
    [
        (damage_empty_cloud, "points", "velodyne/000001.bin", "an empty file"),
        (damage_cut_cloud, "points", "velodyne/000001.bin", "797 bytes"),
        (damage_nan_cloud, "points", "velodyne/000001.bin", "1 of 50 points with NaN .*point 4"),
        (damage_huge_cloud, "points", "velodyne/000001.bin", "1e\\+09 m"),
        (damage_missing_cloud, "points", "velodyne/000001.bin", "no such file"),
        (damage_cut_image, "image", "image_2/000001.png", "ends after 3000 bytes"),
        (damage_flipped_image, "image", "image_2/000001.png", "damaged b'IDAT' chunk"),
        (damage_text_image, "image", "image_2/000001.png", "starting with b'not '"),
        (damage_calibration, "calibration", "calib/000001.txt", "expected a line 'P2:', got P0, P1, P3"),
        (damage_label, "labels", "label_2/000001.txt", "000001.txt:1: column 'alpha' is not a number: 'x'"),
        (damage_depth, "target_depth", "depth_2/000001.png", "uint8"),
    ],
)
def test_damage_is_named_and_other_frames_are_right(root, damage, part, file, found) -> None:
    damage(root / "training")
    dataset = open_dataset("kitti_object", root)
    assert dataset.ids == ("000000", "000001", "000002")
    with pytest.raises(DataError, match=f"{file}.*{found}"):
        getattr(dataset["000001"], part)
    assert getattr(dataset["000002"], part) is not None


def test_a_cut_jpeg_is_refused(root: Path, rng: np.random.Generator) -> None:
    import cv2

    path = root / "training" / "image_2" / "000001.jpg"
    data = cv2.imencode(".jpg", rng.integers(0, 255, (40, 80, 3), dtype=np.uint8))[1].tobytes()
    path.write_bytes(data[: len(data) // 2])
    (root / "training" / "image_2" / "000001.png").unlink()
    with pytest.raises(DataError, match="complete JPEG image"):
        _ = open_dataset("kitti_object", root)["000001"].image


def test_an_image_header_of_absurd_size_is_refused_before_decoding(root: Path) -> None:
    import struct
    import zlib

    path = root / "training" / "image_2" / "000001.png"
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", 2**31 - 1, 2**31 - 1)
    data[29:33] = struct.pack(">I", zlib.crc32(bytes(data[12:29])))
    path.write_bytes(bytes(data))
    with pytest.raises(DataError, match="header of 2147483647 x 2147483647"):
        _ = open_dataset("kitti_object", root)["000001"].image


def test_a_frame_without_label_says_so(root: Path) -> None:
    (root / "training" / "label_2" / "000001.txt").unlink()
    frame = open_dataset("kitti_object", root)["000001"]
    assert not frame.has("labels")
    with pytest.raises(MissingPart, match="frame 000001: expected labels"):
        _ = frame.labels


def test_result_files_are_read_back_with_scores(tmp_path: Path) -> None:
    write_objects(tmp_path / "a.txt", [replace(CAR, score=0.25)])
    (read,) = read_labels(tmp_path / "a.txt", scored=True)
    assert read.score == 0.25
    assert read_labels(tmp_path / "a.txt") == [CAR]
    write_objects(tmp_path / "b.txt", [])
    assert (tmp_path / "b.txt").read_bytes() == b""
    assert read_labels(tmp_path / "b.txt", scored=True) == []


@pytest.mark.real_data
def test_real_frames(kitti_object: Path) -> None:
    dataset = open_dataset("kitti_object", kitti_object)
    assert len(dataset) == 11
    cars = [sum(item.type == "Car" for item in frame.labels) for frame in dataset]
    assert cars == [0, 1, 1, 1, 2, 0, 4, 3, 6, 3, 8]
    frame = dataset["000008"]
    assert frame.image.shape[:2] == frame.image_size == (375, 1242)
    assert 108_000 < len(frame.points) < 127_000
    valid = int((frame.sparse_depth > 0).sum())
    assert 14_000 < valid < 21_000
