"""A user's own folder and the cloud files it may hold; independent readers for PLY and PCD."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.base.errors import DataError, UsageError
from pipeline.data import open_dataset
from pipeline.data.cloud_files import Cloud, pcd_bytes, ply_bytes, read_cloud, read_points
from pipeline.geometry.calibration import format_calibration
from tests.pipeline.tiny_kitti import CALIBRATION

COLUMNS = ("x", "y", "z", "intensity", "source", "sigma")


@pytest.fixture
def cloud(rng: np.random.Generator) -> Cloud:
    return Cloud(rng.normal(size=(7, 6)).astype(np.float32), COLUMNS)


def test_ply_is_what_the_format_page_says(cloud: Cloud) -> None:
    head, _, body = ply_bytes(cloud).partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 7"]
    assert lines[3:] == [f"property float {name}" for name in COLUMNS]
    np.testing.assert_array_equal(np.frombuffer(body, "<f4").reshape(7, 6), cloud.values)


def test_pcd_is_what_the_format_page_says(cloud: Cloud) -> None:
    head, _, body = pcd_bytes(cloud).partition(b"DATA binary\n")
    fields = dict(line.split(" ", 1) for line in head.decode().splitlines() if not line.startswith("#"))
    assert fields["FIELDS"].split() == list(COLUMNS)
    assert fields["SIZE"] == "4 4 4 4 4 4"
    assert fields["TYPE"] == "F F F F F F"
    assert (fields["WIDTH"], fields["HEIGHT"], fields["POINTS"]) == ("7", "1", "7")
    np.testing.assert_array_equal(np.frombuffer(body, "<f4").reshape(7, 6), cloud.values)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_round_trip(cloud: Cloud, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cloud{suffix}"
    path.write_bytes(ply_bytes(cloud) if suffix == ".ply" else pcd_bytes(cloud))
    read = read_cloud(path)
    assert read.columns == COLUMNS
    np.testing.assert_array_equal(read.values, cloud.values)
    np.testing.assert_array_equal(read_points(path), cloud.values[:, :4])


def test_open3d_reads_them(cloud: Cloud, tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d")
    for suffix, data in ((".ply", ply_bytes(cloud)), (".pcd", pcd_bytes(cloud))):
        path = tmp_path / f"cloud{suffix}"
        path.write_bytes(data)
        points = np.asarray(o3d.io.read_point_cloud(str(path)).points)
        np.testing.assert_allclose(points, cloud.values[:, :3])


def test_ascii_files_and_other_types(tmp_path: Path) -> None:
    ply = tmp_path / "a.ply"
    ply.write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty float y\nproperty float z\n"
        "property uchar i\nend_header\n1 2 3 9\n4 5 6 8\n"
    )
    np.testing.assert_array_equal(read_points(ply), [[1, 2, 3, 9], [4, 5, 6, 8]])
    pcd = tmp_path / "a.pcd"
    pcd.write_text(
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        "WIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n1 2 3\n"
    )
    np.testing.assert_array_equal(read_points(pcd), [[1, 2, 3, 0]])


def test_damage_is_named(cloud: Cloud, tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(ply_bytes(cloud)[:-5])
    with pytest.raises(DataError, match="truncated"):
        read_cloud(path)
    path.write_bytes(b"hello")
    with pytest.raises(DataError, match="end_header"):
        read_cloud(path)
    np.save(tmp_path / "a.npy", np.array([{"x": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(DataError, match="npy array of numbers"):
        read_cloud(tmp_path / "a.npy")


def test_the_users_folder(cloud: Cloud, tmp_path: Path, rng: np.random.Generator) -> None:
    image = rng.integers(0, 255, (48, 96, 3), dtype=np.uint8)
    for name in ("images", "points", "labels", "semantics"):
        (tmp_path / name).mkdir()
    (tmp_path / "calib.txt").write_text(format_calibration(CALIBRATION))
    for index, suffix in enumerate((".bin", ".npy", ".ply")):
        cv2.imwrite(str(tmp_path / "images" / f"day_{index}.png"), image[:, :, ::-1])
        path = tmp_path / "points" / f"day_{index}{suffix}"
        points = cloud.values[:, :4]
        if suffix == ".bin":
            path.write_bytes(points.tobytes())
        elif suffix == ".npy":
            np.save(path, points)
        else:
            path.write_bytes(ply_bytes(cloud))
    (tmp_path / "labels" / "day_0.txt").write_text("Car 0 0 0 1 2 30 40 1.5 1.6 4 0 1.6 9 0\n")
    cv2.imwrite(str(tmp_path / "semantics" / "day_1.png"), np.full((48, 96), 13, np.uint8))
    dataset = open_dataset("folder", tmp_path)
    assert dataset.ids == ("day_0", "day_1", "day_2")
    for frame in dataset:
        np.testing.assert_array_equal(frame.image, image)
        np.testing.assert_array_equal(frame.points, cloud.values[:, :4])
        np.testing.assert_allclose(frame.calibration.P2, CALIBRATION.P2)
    assert dataset[0].labels[0].size == (1.5, 1.6, 4.0)
    assert not dataset[1].has("labels")
    assert (dataset[1].semantics == 13).all()


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no image found"):
        open_dataset("folder", tmp_path)
