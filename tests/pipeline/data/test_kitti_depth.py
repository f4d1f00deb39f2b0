"""KITTI depth completion: the three layouts, official crop, refusal of 8-bit maps, the real sample."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.base.errors import DataError, MissingPart, UsageError
from pipeline.data import open_dataset
from pipeline.data.kitti_depth import cropped_frame, official_crop

DRIVE = "2011_09_26_drive_0001_sync"
CAM_TO_CAM = (
    "calib_time: 09-Jan-2012 13:57:47\n"
    "R_rect_00: 1 0 0 0 1 0 0 0 1\n"
    "P_rect_02: 700 0 600 44 0 700 170 0.2 0 0 1 0.0027\n"
    "P_rect_03: 700 0 600 -339 0 700 170 2.2 0 0 1 0.0027\n"
)
VELO_TO_CAM = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 -0.08 -0.27\n"


def write_png(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)


def depth_code(value: int, shape: tuple[int, int] = (20, 40)) -> np.ndarray:
    code = np.zeros(shape, np.uint16)
    code[10:, ::3] = value
    return code


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for camera in ("image_02", "image_03"):
        for number in (5, 6):
            proj = tmp_path / "data_depth_annotated" / "val" / DRIVE / "proj_depth" / "groundtruth" / camera
            write_png(proj / f"{number:010d}.png", depth_code(256 * number))
        raw = tmp_path / "data_depth_velodyne" / "val" / DRIVE / "proj_depth" / "velodyne_raw" / camera
        # More sparse maps than ground truth, as in the real set: pairing two listings would be wrong.
        for number in (4, 5, 6):
            write_png(raw / f"{number:010d}.png", depth_code(256 * number + 128))
        image = tmp_path / "2011_09_26" / DRIVE / camera / "data" / "0000000005.png"
        write_png(image, np.full((20, 40, 3), (1, 2, 3), np.uint8))
    (tmp_path / "2011_09_26" / "calib_cam_to_cam.txt").write_text(CAM_TO_CAM)
    (tmp_path / "2011_09_26" / "calib_velo_to_cam.txt").write_text(VELO_TO_CAM)
    return tmp_path


def test_the_tree_is_enumerated_from_its_ground_truth(tree: Path) -> None:
    dataset = open_dataset("kitti_depth", tree)
    assert dataset.ids[0] == f"val/{DRIVE}/image_02/0000000005"
    assert len(dataset) == 4
    frame = dataset[f"val/{DRIVE}/image_03/0000000006"]
    assert frame.target_depth.max() == 6.0
    assert frame.sparse_depth.max() == 6.5
    with pytest.raises(MissingPart):
        _ = frame.image


def test_tree_frames_know_their_camera(tree: Path) -> None:
    left, right = (open_dataset("kitti_depth", tree)[f"val/{DRIVE}/image_0{c}/0000000005"] for c in (2, 3))
    assert left.image[0, 0].tolist() == [3, 2, 1]
    assert (left.calibration.P2[0, 3], right.calibration.P2[0, 3]) == (44, -339)
    assert left.image_size == (20, 40)


def test_unpacked_zips_without_their_names(tree: Path) -> None:
    for kind in ("annotated", "velodyne"):
        shutil.copytree(tree / f"data_depth_{kind}" / "val", tree / "flat" / "val", dirs_exist_ok=True)
    dataset = open_dataset("kitti_depth", tree / "flat")
    assert dataset[0].sparse_depth.max() == 5.5


def test_selected_val_and_test(tmp_path: Path) -> None:
    val = tmp_path / "val_selection_cropped"
    stem = f"{DRIVE}_{{}}_0000000005_image_02"
    write_png(val / "image" / (stem.format("image") + ".png"), np.zeros((20, 40, 3), np.uint8))
    write_png(val / "velodyne_raw" / (stem.format("velodyne_raw") + ".png"), depth_code(512))
    write_png(val / "groundtruth_depth" / (stem.format("groundtruth_depth") + ".png"), depth_code(768))
    (val / "intrinsics").mkdir()
    (val / "intrinsics" / (stem.format("image") + ".txt")).write_text("721.5 0 596.5 0 721.5 149.8 0 0 1")
    frame = open_dataset("kitti_depth", val)[f"{DRIVE}_0000000005_image_02"]
    assert (frame.sparse_depth.max(), frame.target_depth.max()) == (2.0, 3.0)
    assert frame.calibration.K[1, 2] == 149.8

    test = tmp_path / "test_depth_completion_anonymous"
    write_png(test / "image" / "0000000000.png", np.zeros((20, 40, 3), np.uint8))
    write_png(test / "velodyne_raw" / "0000000000.png", depth_code(512))
    (frame,) = open_dataset("kitti_depth", test)
    assert not frame.has("target_depth")
    assert frame.sparse_depth.max() == 2.0


def test_eight_bit_maps_are_refused(tree: Path) -> None:
    folder = tree / "data_depth_annotated" / "val" / DRIVE / "proj_depth" / "groundtruth" / "image_02"
    write_png(folder / "0000000005.png", np.full((20, 40), 7, np.uint8))
    with pytest.raises(DataError, match=r"0000000005\.png: expected .*16-bit"):
        _ = open_dataset("kitti_depth", tree)[0].target_depth


def test_official_crop() -> None:
    # KITTI's five image sizes; Python rounds 6.5 and 4.5 to the even neighbour as the reference loaders do.
    expected = {(375, 1242): (23, 13), (374, 1238): (22, 11), (370, 1224): (18, 4), (376, 1241): (24, 12)}
    for size, corner in expected.items():
        assert official_crop(size) == corner
    with pytest.raises(ValueError, match="smaller"):
        official_crop((300, 1242))


def test_the_real_sample_and_its_crop(kitti_depth: Path) -> None:
    (frame,) = open_dataset("kitti_depth", kitti_depth)
    depth = frame.target_depth
    assert frame.image_size == depth.shape == (375, 1242)
    assert 0.15 < (depth > 0).mean() < 0.25
    cut = cropped_frame(frame)
    assert cut.image.shape == (352, 1216, 3)
    np.testing.assert_array_equal(cut.target_depth, depth[23:, 13 : 13 + 1216])
    assert cut.calibration.K[1, 2] == pytest.approx(172.854 - 23)
    assert cut.calibration.K[0, 2] == pytest.approx(609.5593 - 13)


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no KITTI depth frame"):
        open_dataset("kitti_depth", tmp_path)


def test_raw_drives_survive_missing_clouds(tree: Path) -> None:
    drive = tree / "2011_09_26" / DRIVE
    write_png(drive / "image_02" / "data" / "0000000006.png", np.zeros((20, 40, 3), np.uint8))
    points = np.array([[10, 0, 0, 0.5], [20, 1, -1, 0.25]], "<f4")
    cloud = drive / "velodyne_points" / "data" / "0000000005.bin"
    cloud.parent.mkdir(parents=True)
    cloud.write_bytes(points.tobytes())
    for root in (tree, tree / "2011_09_26"):
        dataset = open_dataset("kitti_raw", root)
        assert dataset.ids == (f"{DRIVE}/0000000005", f"{DRIVE}/0000000006")
        np.testing.assert_array_equal(dataset[0].points, points)
        assert dataset[0].calibration.P3 is not None
        assert not dataset[1].has("points")
    # (10, 0, 0) -> camera (0, -0.08, 9.73) -> u = (700 * 0 + 600 * 9.73 + 44) / 9.7327
    pixels, depth = dataset[0].calibration.cam_to_image(dataset[0].calibration.velo_to_cam(points[:1]))
    assert depth[0] == pytest.approx(9.73)
    assert pixels[0, 0] == pytest.approx((600 * 9.73 + 44) / 9.7327)
