"""Planted faults: the doctor names exactly the fault that was planted, and nothing on the clean real frames."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.base.errors import UsageError
from pipeline.check.doctor import check
from pipeline.data import open_dataset
from pipeline.data.depth_png import decode_depth, encode_depth, png_bytes

FRAMES = ("000001", "000002", "000003", "000004", "000007", "000008")
VICTIM = "000003"


def names(path: Path, **options: object) -> set[str]:
    return {finding.fault for finding in check(path, workers=1, **options).findings}  # type: ignore[arg-type]


@pytest.fixture
def kitti(kitti_object: Path, tmp_path: Path) -> Path:
    """Six real frames; files are links until a test replaces them."""
    root = tmp_path / "kitti"
    for part, suffix in (("image_2", "png"), ("velodyne", "bin"), ("calib", "txt"), ("label_2", "txt")):
        folder = root / "training" / part
        folder.mkdir(parents=True)
        for frame in FRAMES:
            (folder / f"{frame}.{suffix}").symlink_to(kitti_object / "training" / part / f"{frame}.{suffix}")
    return root


def part_path(root: Path, part: str, frame: str = VICTIM) -> Path:
    suffix = {"image_2": "png", "velodyne": "bin", "depth_2": "png"}.get(part, "txt")
    return root / "training" / part / f"{frame}.{suffix}"


def replace(path: Path, data: bytes | str) -> None:
    path.unlink(missing_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)


def edit_cloud(root: Path, change: Callable[[np.ndarray], np.ndarray], frame: str = VICTIM) -> None:
    path = part_path(root, "velodyne", frame)
    points = np.frombuffer(path.read_bytes(), "<f4").reshape(-1, 4).copy()
    replace(path, np.ascontiguousarray(change(points), "<f4").tobytes())


def edit_labels(root: Path, change: Callable[[list[str]], list[str]], frame: str = VICTIM) -> None:
    path = part_path(root, "label_2", frame)
    lines = [line.split() for line in path.read_text().splitlines()]
    edited = [change(fields) if fields[0] != "DontCare" else fields for fields in lines]
    replace(path, "".join(" ".join(fields) + "\n" for fields in edited))


def dense(root: Path, frame: str) -> np.ndarray:
    """A depth map as a good network would give: the LiDAR, grown by its neighbours."""
    sparse = open_dataset("kitti_object", root)[frame].sparse_depth
    grown = cv2.dilate(np.divide(1, sparse, out=np.zeros_like(sparse), where=sparse > 0), np.ones((9, 9)))
    return np.where(sparse > 0, sparse, np.divide(1, grown, out=np.zeros_like(grown), where=grown > 0))


def plant_depth(root: Path, change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
    """depth_2 maps of every frame, the victim's changed: change(map, map of the next frame) -> uint16."""
    for frame in FRAMES:
        code = encode_depth(dense(root, frame))
        if frame == VICTIM:
            code = change(code, encode_depth(dense(root, "000004")))
        replace(part_path(root, "depth_2", frame), png_bytes(code))


def test_it_is_silent_on_the_clean_real_frames(kitti_object: Path, kitti_depth: Path, nyu: Path) -> None:
    for root in (kitti_object, kitti_depth, nyu):
        report = check(root, workers=1)
        assert report.findings == ()
        assert report.clean
    assert check(kitti_object, workers=1).frames == 11


def test_it_is_silent_on_good_depth(kitti: Path) -> None:
    plant_depth(kitti, lambda code, _: code)
    assert names(kitti) == set()


# ---- clouds -------------------------------------------------------------------------------------------------------

CLOUD_FAULTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "non_finite_points": lambda p: np.where(np.arange(len(p))[:, None] == 77, np.nan, p),
    "cloud_in_millimetres": lambda p: p * [1000, 1000, 1000, 1],
    "axis_order": lambda p: p[:, [0, 2, 1, 3]],
    "float16_loss": lambda p: p.astype(np.float16),
    "intensity_scale": lambda p: p * [1, 1, 1, 255],
    "truncated_cloud": lambda p: p[: len(p) // 2],
}


@pytest.mark.parametrize("fault", CLOUD_FAULTS)
def test_cloud_faults(kitti: Path, fault: str) -> None:
    edit_cloud(kitti, CLOUD_FAULTS[fault])
    assert names(kitti) == {fault}


def test_forward_and_left_exchanged_is_seen_by_the_labels(kitti: Path) -> None:
    edit_cloud(kitti, lambda p: p[:, [1, 0, 2, 3]])
    assert names(kitti) == {"axis_order"}


def test_a_cloud_cut_inside_a_row(kitti: Path) -> None:
    path = part_path(kitti, "velodyne")
    replace(path, path.read_bytes()[:100_001])
    assert names(kitti) == {"truncated_cloud"}


# ---- files --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", ["image_2", "velodyne", "calib", "label_2"])
def test_missing_files(kitti: Path, part: str) -> None:
    part_path(kitti, part).unlink()
    report = check(kitti, workers=1)
    assert {finding.fault for finding in report.findings} == {"missing_file"}
    assert {finding.frame for finding in report.findings} == {VICTIM}


def test_an_extra_file(kitti: Path) -> None:
    cloud = part_path(kitti, "velodyne").read_bytes()
    points = np.frombuffer(cloud, "<f4").reshape(-1, 4)[::-1]
    replace(part_path(kitti, "velodyne", "000099"), points.tobytes())
    assert names(kitti) == {"extra_file"}


@pytest.mark.parametrize("part", ["image_2", "velodyne", "calib"])
def test_empty_files(kitti: Path, part: str) -> None:
    replace(part_path(kitti, part), b"")
    assert names(kitti) == {"empty_file"}


def test_a_cut_image(kitti: Path) -> None:
    path = part_path(kitti, "image_2")
    replace(path, path.read_bytes()[:50_000])
    assert names(kitti) == {"truncated_file"}


def test_overlapping_splits(kitti: Path) -> None:
    lists = kitti / "ImageSets"
    lists.mkdir()
    (lists / "train.txt").write_text("000001\n000002\n")
    (lists / "val.txt").write_text("000002\n000003\n")
    assert names(kitti) == {"split_overlap"}


# ---- images -------------------------------------------------------------------------------------------------------


def test_red_and_blue_exchanged(kitti: Path) -> None:
    path = part_path(kitti, "image_2")
    replace(path, png_bytes(cv2.imread(str(path))))
    assert names(kitti) == {"rgb_bgr_swap"}


def test_images_of_two_frames_exchanged(kitti: Path) -> None:
    first, second = part_path(kitti, "image_2", "000007"), part_path(kitti, "image_2", "000008")
    one, two = first.read_bytes(), second.read_bytes()
    replace(first, two)
    replace(second, one)
    report = check(kitti, workers=1)
    assert {finding.fault for finding in report.findings} == {"index_offset"}
    assert {finding.frame for finding in report.findings} == {"000007", "000008"}


def test_the_image_of_another_frame(kitti: Path) -> None:
    replace(part_path(kitti, "image_2"), part_path(kitti, "image_2", "000004").read_bytes())
    assert names(kitti) == {"index_offset"}


def test_images_one_frame_late(kitti: Path) -> None:
    images = [part_path(kitti, "image_2", frame).read_bytes() for frame in FRAMES]
    for frame, data in zip(FRAMES, images[1:] + images[:1]):
        replace(part_path(kitti, "image_2", frame), data)
    assert names(kitti) == {"index_offset"}


def test_a_frame_twice(kitti: Path) -> None:
    for part in ("image_2", "velodyne", "label_2"):
        replace(part_path(kitti, part, "000004"), part_path(kitti, part).read_bytes())
    assert names(kitti) == {"duplicated_frame"}


# ---- calibration --------------------------------------------------------------------------------------------------


def test_odometry_calibration(kitti: Path) -> None:
    path = part_path(kitti, "calib")
    kept = [line for line in path.read_text().splitlines() if not line.startswith(("R0_rect", "Tr_imu"))]
    replace(path, "\n".join(kept).replace("Tr_velo_to_cam:", "Tr:") + "\n")
    assert names(kitti) == {"wrong_calibration_family"}


def test_another_rigs_calibration(kitti: Path, kitti_object: Path) -> None:
    other = (kitti_object / "training" / "calib" / "000000.txt").read_text()
    replace(part_path(kitti, "calib"), other)
    assert names(kitti) == {"other_rigs_calibration"}


def test_another_rigs_calibration_everywhere(kitti: Path, kitti_object: Path) -> None:
    other = (kitti_object / "training" / "calib" / "000000.txt").read_text()
    for frame in FRAMES:
        replace(part_path(kitti, "calib", frame), other)
    assert names(kitti) == {"other_rigs_calibration"}


def test_a_rotation_that_is_none(kitti: Path) -> None:
    path = part_path(kitti, "calib")
    replace(path, path.read_text().replace("R0_rect: 9.9992", "R0_rect: 8.9992"))
    assert names(kitti) == {"calibration_not_rigid"}


def test_inverted_extrinsics(kitti: Path) -> None:
    inverse = open_dataset("kitti_object", kitti)[VICTIM].calibration.T_cam0_velo
    numbers = " ".join(f"{value:.12e}" for value in np.linalg.inv(inverse)[:3].ravel())
    path = part_path(kitti, "calib")
    lines = [f"Tr_velo_to_cam: {numbers}" if "Tr_velo" in line else line for line in path.read_text().splitlines()]
    replace(path, "\n".join(lines) + "\n")
    assert names(kitti) == {"wrong_extrinsics"}


# ---- labels -------------------------------------------------------------------------------------------------------


def fields(*changes: tuple[int, Callable[[float], float]]) -> Callable[[list[str]], list[str]]:
    def change(line: list[str]) -> list[str]:
        line = list(line)
        for index, function in changes:
            line[index] = f"{function(float(line[index])):.2f}"
        return line

    return change


def reorder(order: tuple[int, int, int]) -> Callable[[list[str]], list[str]]:
    return lambda line: [*line[:8], *(line[8 + i] for i in order), *line[11:]]


LABEL_FAULTS: dict[str, Callable[[list[str]], list[str]]] = {
    "label_result_mixup": lambda line: [*line, "0.9"],
    "malformed_labels": lambda line: line[:12],
    "degrees_not_radians": fields((14, np.degrees), (3, np.degrees)),
    "yaw_sign": fields((14, lambda ry: -ry + 0.5), (3, lambda alpha: alpha - 0.5)),
    "label_unit": fields(*((index, lambda value: 1000 * value) for index in range(8, 14))),
    "unknown_class": lambda line: ["automobile", *line[1:]],
    "label_outside_image": fields((6, lambda x2: x2 + 1000)),
    "labels_disagree_with_cloud": fields((13, lambda z: z + 9)),
}


@pytest.mark.parametrize("fault", LABEL_FAULTS)
def test_label_faults(kitti: Path, fault: str) -> None:
    if fault == "yaw_sign":
        # KITTI's cars drive along the road, where ry and -ry are alike: turned cars first, consistent with alpha.
        edit_labels(kitti, fields((14, lambda ry: ry + 0.5), (3, lambda alpha: alpha + 0.5)))
        assert names(kitti) == set()
        edit_labels(kitti, fields((14, lambda ry: -ry)))
    else:
        edit_labels(kitti, LABEL_FAULTS[fault])
    assert names(kitti) == {fault}


@pytest.mark.parametrize("order", [(0, 2, 1), (2, 1, 0), (2, 0, 1), (1, 2, 0)])
def test_sizes_in_another_order(kitti: Path, order: tuple[int, int, int]) -> None:
    for frame in FRAMES:
        edit_labels(kitti, reorder(order), frame)
    assert names(kitti) == {"swapped_dimensions"}


def test_labels_of_the_next_frame(kitti: Path) -> None:
    texts = [part_path(kitti, "label_2", frame).read_text() for frame in FRAMES]
    for frame, text in zip(FRAMES, texts[1:] + texts[:1]):
        replace(part_path(kitti, "label_2", frame), text)
    assert "index_offset" in names(kitti)


# ---- depth --------------------------------------------------------------------------------------------------------


def shifted(code: np.ndarray, rows: int, columns: int) -> np.ndarray:
    moved = np.zeros_like(code)
    height, width = code.shape
    moved[rows:, columns:] = code[: height - rows, : width - columns]
    return moved


def as_range(code: np.ndarray, _: np.ndarray) -> np.ndarray:
    v, u = np.indices(code.shape)
    rays = np.sqrt(1 + ((u - 609.56) / 721.54) ** 2 + ((v - 172.85) / 721.54) ** 2)
    return encode_depth(decode_depth(code) * rays)


def random_weights(code: np.ndarray, _: np.ndarray) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(3).normal(size=code.shape), (0, 0), 8)
    return encode_depth(30 + 20 * noise / np.abs(noise).max())


DEPTH_FAULTS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "eight_bit_depth": lambda code, _: (code >> 8).astype(np.uint8),
    "wrong_crop": lambda code, _: shifted(code, 23, 13),
    "depth_unit": lambda code, _: (decode_depth(code) * 1000).clip(0, 65534).astype(np.uint16),
    "depth_is_range": as_range,
    "index_offset": lambda code, other: other,
    "depth_disagrees_with_lidar": random_weights,
    "far_plane_as_depth": lambda code, _: np.where(np.arange(len(code))[:, None] < 50, 65535, code).astype(np.uint16),
}


@pytest.mark.parametrize("fault", DEPTH_FAULTS)
def test_depth_faults(kitti: Path, fault: str) -> None:
    plant_depth(kitti, DEPTH_FAULTS[fault])
    report = check(kitti, workers=1)
    assert {finding.fault for finding in report.findings} == {fault}
    assert {finding.frame for finding in report.findings} == {VICTIM}


def test_a_crop_from_the_top_left_corner(kitti: Path) -> None:
    plant_depth(kitti, lambda code, _: code[:352, :1216])
    assert names(kitti) == {"wrong_crop"}


def test_the_official_crop_is_no_fault(kitti: Path) -> None:
    plant_depth(kitti, lambda code, _: code[23:, 13 : 13 + 1216])
    assert names(kitti) == set()


def test_images_moved_by_a_crop(kitti: Path) -> None:
    for frame in FRAMES:
        path = part_path(kitti, "image_2", frame)
        image = cv2.imread(str(path))[:, :, ::-1]
        moved = np.zeros_like(image)
        moved[23:, 13:] = image[: len(image) - 23, :-13]
        replace(path, png_bytes(moved))
    assert names(kitti) == {"wrong_crop"}


def test_a_cropped_image_with_the_full_calibration(kitti: Path) -> None:
    path = part_path(kitti, "image_2")
    replace(path, png_bytes(np.ascontiguousarray(cv2.imread(str(path))[23:, 13:1229, ::-1])))
    assert names(kitti) == {"wrong_crop"}


def test_the_calibration_of_a_crop_with_the_full_image(kitti: Path) -> None:
    path = part_path(kitti, "calib")
    replace(path, path.read_text().replace("1.728540000000e+02", "1.498540000000e+02"))
    assert names(kitti) == {"wrong_crop"}


def test_a_number_left_out(kitti_object: Path, tmp_path: Path) -> None:
    shutil.copytree(kitti_object / "training" / "label_2", tmp_path / "training" / "label_2")
    for part in ("velodyne", "calib"):
        (tmp_path / "training" / part).mkdir()
        for path in (kitti_object / "training" / part).iterdir():
            if path.stem != "000005":
                (tmp_path / "training" / part / path.name).symlink_to(path)
    (tmp_path / "training" / "label_2" / "000005.txt").chmod(0o644)
    (tmp_path / "training" / "label_2").chmod(0o755)
    (tmp_path / "training" / "label_2" / "000005.txt").unlink()
    report = check(tmp_path, workers=1)
    assert [(finding.fault, finding.frame) for finding in report.findings] == [("missing_file", "000005")]


def test_intrinsics_of_the_uncropped_image(kitti_depth: Path, tmp_path: Path) -> None:
    (frame,) = kitti_depth.iterdir()
    shutil.copytree(frame, tmp_path / "depth" / "frame", copy_function=shutil.copyfile)
    for name in ("image.png", "groundtruth_depth.png"):
        pixels = cv2.imread(str(frame / name), cv2.IMREAD_UNCHANGED)[23:, 13 : 13 + 1216]
        cv2.imwrite(str(tmp_path / "depth" / "frame" / name), pixels)
    assert names(tmp_path / "depth") == {"wrong_crop"}


# ---- report -------------------------------------------------------------------------------------------------------


def test_findings_do_not_depend_on_the_number_of_workers(kitti: Path) -> None:
    edit_cloud(kitti, CLOUD_FAULTS["axis_order"])
    part_path(kitti, "label_2", "000004").unlink()
    assert check(kitti, workers=1) == check(kitti, workers=2)


def test_the_verb_exits_with_1_and_prints_json(kitti: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from pipeline.cli import main

    replace(part_path(kitti, "velodyne"), b"")
    assert main(["--stage", "check", str(kitti), "--workers", "1", "--json"]) == 1
    record = json.loads(capsys.readouterr().out)
    assert record["faults"] == {"empty_file": 1}
    assert record["findings"][0]["frame"] == VICTIM
    assert main(["--stage", "check", "--data", str(kitti), "--frames", "000001,000002", "--workers", "1"]) == 0


def test_unknown_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="not recognised"):
        check(tmp_path)
    with pytest.raises(UsageError, match="no such folder"):
        check(tmp_path / "absent")
