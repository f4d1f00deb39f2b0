"""Virtual KITTI 2: a tree written from the format page is read back, its boxes lie on its masks."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from detection.boxes import project_to_image
from detection.kitti_format import boxes_of
from pipeline.base.errors import DataError, UsageError
from pipeline.data import open_dataset
from pipeline.data.vkitti2 import camera_pose, read_objects, thesis_split
from pipeline.data.vkitti2_difficulty import RULES, count_difficulties, difficulty
from tests.pipeline.data.vkitti2_tree import BASELINE, CARS, CX, CY, FOCAL, HEIGHT, WIDTH, write_tree


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("vkitti2")
    for scene in ("Scene01", "Scene20"):
        write_tree(root, scene, 2)
    return write_tree(root, "Scene20", 1, "15-deg-left")


def test_every_scene_variation_and_camera_is_listed(tree: Path) -> None:
    dataset = open_dataset("vkitti2", tree)
    assert len(dataset) == 2 * 2 + 2 * 2 + 2
    assert dataset.ids[0] == "Scene01/clone/Camera_0/00000"
    assert len(dataset.select("Scene20/15-deg-left/*")) == 2


def test_depth_is_centimetres_and_sky_has_none(tree: Path) -> None:
    frame = open_dataset("vkitti2", tree)["Scene01/clone/Camera_0/00000"]
    assert frame.image_size == (HEIGHT, WIDTH)
    depth = frame.target_depth
    assert depth[0, 0] == 0
    assert depth[300, 5] == pytest.approx(30.0)
    left, right, top, bottom = read_objects(tree, frame.id)[0].box
    assert depth[int(top + bottom) // 2, int(left + right) // 2] == pytest.approx(12.0)


def test_boxes_project_onto_their_instance_masks(tree: Path) -> None:
    for frame in open_dataset("vkitti2", tree):
        labels = frame.labels
        rectangles = project_to_image(boxes_of(labels), frame.calibration.P2, frame.image_size)
        for item, rectangle, (track, *_) in zip(labels, rectangles, CARS):
            v, u = np.nonzero(frame.instances == track + 1)
            # Inclusive integer pixels within a rectangle of real edges: at most a pixel off; the mask lacks its top.
            assert np.abs(np.array([u.min(), u.max(), v.max()]) - rectangle[[0, 2, 3]]).max() <= 1
            assert np.abs(np.array(item.bbox) - rectangle).max() <= 1


def test_labels_are_in_kitti_form(tree: Path) -> None:
    car, van = open_dataset("vkitti2", tree)["Scene01/clone/Camera_0/00000"].labels
    assert (car.type, van.type) == ("Car", "Van")
    assert car.size == (1.5, 1.6, 4.0)
    assert van.location == (3.0, 1.6, 20.0)
    assert van.ry == pytest.approx(0.4)
    assert car.alpha == pytest.approx(-1.57 - np.arctan2(-2.0, 12.0), abs=1e-6)
    # Both fill their rectangle as much as cars in full view do.
    assert (car.occluded, van.occluded) == (0, 0)


def test_the_right_camera_sees_the_same_world(tree: Path) -> None:
    left, right = (f"Scene20/clone/Camera_{camera}/00001" for camera in (0, 1))
    T_right_left = camera_pose(tree, right) @ np.linalg.inv(camera_pose(tree, left))
    np.testing.assert_allclose(T_right_left[:3, 3], [-BASELINE, 0, 0], atol=1e-9)
    a, b = read_objects(tree, left)[0], read_objects(tree, right)[0]
    moved = T_right_left @ [*a.location, 1]
    np.testing.assert_allclose(moved[:3], b.location, atol=1e-9)


def test_calibration_has_no_lidar_offset(tree: Path) -> None:
    calibration = open_dataset("vkitti2", tree)["Scene01/clone/Camera_0/00000"].calibration
    np.testing.assert_allclose(calibration.K, [[FOCAL, 0, CX], [0, FOCAL, CY], [0, 0, 1]])
    np.testing.assert_allclose(calibration.velo_to_cam(np.array([[10.0, 2.0, 1.0]])), [[-2.0, -1.0, 10.0]])


def test_parts_name_the_files_they_are_read_from(tree: Path) -> None:
    frame = open_dataset("vkitti2", tree)[0]
    names = {part: {path.name for path in frame.files(part)} for part in ("calibration", "sparse_depth", "points")}
    depth = {"intrinsic.txt", "depth_00000.png"}
    assert names == {"calibration": {"intrinsic.txt"}, "sparse_depth": depth, "points": depth}
    assert all(path.is_file() for part in names for path in frame.files(part))


def test_classes_become_train_ids(tree: Path) -> None:
    frame = open_dataset("vkitti2", tree)["Scene01/clone/Camera_0/00000"]
    assert frame.semantics[0, 0] == 10
    assert frame.semantics[374, 0] == 0
    left, _, _, bottom = read_objects(tree, frame.id)[0].box
    assert frame.semantics[int(bottom), int(left)] == 13


def test_a_recompressed_class_image_is_refused(tree: Path, tmp_path: Path) -> None:
    write_tree(tmp_path, "Scene01", 1)
    path = tmp_path / "Scene01/clone/frames/classSegmentation/Camera_0/classgt_00000.png"
    cv2.imwrite(str(path), cv2.GaussianBlur(cv2.imread(str(path)), (0, 0), 9))
    with pytest.raises(DataError, match=r"colours of colors\.txt"):
        _ = open_dataset("vkitti2", tmp_path)["Scene01/clone/Camera_0/00000"].semantics


def test_an_eight_bit_depth_is_refused(tmp_path: Path) -> None:
    write_tree(tmp_path, "Scene01", 1)
    path = tmp_path / "Scene01/clone/frames/depth/Camera_0/depth_00000.png"
    cv2.imwrite(str(path), np.zeros((4, 4), np.uint8))
    with pytest.raises(DataError, match="16-bit"):
        _ = open_dataset("vkitti2", tmp_path)["Scene01/clone/Camera_0/00000"].target_depth


def test_archives_in_folders_of_their_own(tmp_path: Path) -> None:
    write_tree(tmp_path / "all", "Scene02", 1)
    for part in ("rgb", "depth", "classSegmentation", "instanceSegmentation"):
        target = tmp_path / "split" / f"vkitti_2.0.3_{part}" / "Scene02" / "clone" / "frames"
        target.mkdir(parents=True)
        (tmp_path / "all/Scene02/clone/frames" / part).rename(target / part)
    texts = tmp_path / "split" / "vkitti_2.0.3_textgt" / "Scene02" / "clone"
    texts.mkdir(parents=True)
    for path in (tmp_path / "all/Scene02/clone").glob("*.txt"):
        path.rename(texts / path.name)
    (frame, _) = open_dataset("vkitti2", tmp_path / "split")
    assert len(frame.labels) == 2
    assert frame.target_depth.max() == pytest.approx(30.0)


def test_thesis_splits(tree: Path) -> None:
    dataset = open_dataset("vkitti2", tree)
    assert {name.split("/")[0] for name in thesis_split(dataset, "train").ids} == {"Scene01"}
    assert len(thesis_split(dataset, "test")) == 4
    assert thesis_split(dataset, "test_completion").ids == ("Scene20/clone/Camera_0/00000",)
    with pytest.raises(UsageError, match="unknown Virtual KITTI 2 split"):
        thesis_split(dataset, "validation")


@pytest.mark.parametrize(
    ("height", "truncation", "occlusion", "level"),
    [
        (41, 0.09, 0.09, "easy"),
        (40, 0.0, 0.0, "medium"),
        (60, 0.1, 0.0, "medium"),
        (30, 0.0, 0.0, "medium"),
        (20, 0.5, 0.6, "medium"),
        (19.9, 0.0, 0.0, "hard"),
        (50, 0.9, 1.0, "hard"),
        (14.9, 0.0, 0.0, "ignored"),
        (50, 0.91, 0.0, "ignored"),
    ],
)
def test_difficulty_is_cumulative(height: float, truncation: float, occlusion: float, level: str) -> None:
    assert difficulty(height, truncation, occlusion) == level


def test_the_literal_rule_makes_visible_cars_hard(tree: Path) -> None:
    ids = thesis_split(open_dataset("vkitti2", tree), "test").ids
    counts = {rule: count_difficulties(tree, ids, rule) for rule in RULES}
    # Four cars, all in full view and taller than 40 px; they fill 3/4 of their rectangles.
    assert counts["fill"]["easy"] == 4
    assert counts["hull"]["easy"] == 4
    assert counts["literal"] == {"easy": 0, "medium": 4, "hard": 0, "ignored": 0}


def test_counts_come_out_of_one_command(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from pipeline.cli import main

    assert main(["--stage", "check", str(tree), "--difficulty", "--occlusion", "fill"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["train", "4", "fill", "4", "0", "0", "0"] in lines
    assert ["test", "4", "fill", "4", "0", "0", "0"] in lines


def test_the_doctor_finds_nothing(tree: Path) -> None:
    from pipeline.check.doctor import check

    assert check(tree, workers=1).findings == ()
