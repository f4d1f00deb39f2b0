from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detection.boxes import corners
from detection.frustum.frustums import cut_frustum, frustum_rotation, is_looked_into, rotate, viewed_cloud
from detection.frustum.regions import (
    Region,
    instance_regions,
    mask_regions,
    object_regions,
    parse_detection_list,
)
from detection.frustum.samples import (
    augmented,
    depth_shift,
    flipped,
    frame_samples,
    inside_box,
    moved_box,
    thinned,
)
from detection.kitti_format import boxes_of
from detection.types import PointFrame
from tests.detection.scenes import IMAGE_SIZE, P2, T_CAM_VELO, box_frame

LIST = """\
dataset/KITTI/object/training/image_2/000001.png 2 0.999 387 181 423 203
dataset/KITTI/object/training/image_2/000001.png 1 0.013 -4 10 20 90
dataset/KITTI/object/training/image_2/000007.png 3 0.5 1200 100 1250 200
"""


def test_detection_lists_are_read() -> None:
    found = parse_detection_list(LIST)
    assert list(found) == ["000001", "000007"]
    first, second = found["000001"]
    assert (first.type, first.bbox, first.score) == ("Car", (387, 181, 423, 203), 0.999)
    assert (second.type, second.bbox) == ("Pedestrian", (-4, 10, 20, 90))
    assert found["000007"][0].type == "Cyclist"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("a/1.png 2 0.9 1 2 3", "expected 7 columns"),
        ("a/1.png 4 0.9 1 2 3 4", "class 4; expected 1"),
        ("a/1.png 2 high 1 2 3 4", "not a number"),
        ("a/1.png 2 nan 1 2 3 4", "expected a finite score"),
        ("a/1.png 2 0.9 5 2 3 4", "x1 < x2"),
    ],
)
def test_wrong_lines_are_named(line: str, message: str) -> None:
    with pytest.raises(ValueError, match=rf"^val.txt:2: .*{message}"):
        parse_detection_list(f"a/1.png 2 0.9 1 2 3 4\n{line}\n", where="val.txt")


def test_labels_and_results_give_their_boxes() -> None:
    _, labels = box_frame(0, cars=2)
    van, scored = replace(labels[0], type="Van"), replace(labels[1], score=0.25)
    regions = object_regions([van, scored])
    assert [(one.type, one.bbox, one.score) for one in regions] == [("Car", labels[1].bbox, 0.25)]


def test_masks_give_a_region_for_every_connected_part() -> None:
    classes = np.zeros((20, 30), np.uint8)
    classes[2:10, 3:9] = 13
    classes[12:18, 20:28] = 13
    classes[0:3, 25:28] = 11  # nine pixels: too few
    regions = mask_regions(classes, {13: "Car", 11: "Pedestrian"})
    assert [(one.type, one.bbox) for one in regions] == [("Car", (3, 2, 9, 10)), ("Car", (20, 12, 28, 18))]
    assert regions[0].pixels is not None
    assert int(regions[0].pixels.sum()) == 48
    instances = (classes == 13).astype(np.int32) * 7
    assert [one.bbox for one in instance_regions(instances, {7: "Car", 8: "Car", 9: "Tree"})] == [(3, 2, 28, 18)]


def test_middle_of_a_frustum_looks_ahead() -> None:
    # A point at 20 m on the ray of column 900 lies on the axis after the rotation.
    bbox = (880.0, 150.0, 920.0, 200.0)
    x = (900 - P2[0, 2]) * 20 / P2[0, 0] - P2[0, 3] / P2[0, 0]
    turned = rotate(np.array([[x, 1.0, 20.0]]), frustum_rotation(bbox, P2))
    np.testing.assert_allclose(turned, [[0, 1, np.hypot(x, 20)]], atol=1e-9)


@given(st.floats(-3, 3), st.floats(-20, 20), st.floats(-20, 20))
def test_rotation_is_undone_by_its_negative(angle: float, x: float, z: float) -> None:
    point = np.array([[x, 2.0, z]])
    np.testing.assert_allclose(rotate(rotate(point, angle), -angle), point, atol=1e-9)


def test_borders_of_the_view_and_of_a_box() -> None:
    xyz = np.array([[0.0, 0, 10], [0, 0, 1.9], [30, 0, 10], [0, 0, -5]])
    velo = (xyz - T_CAM_VELO[:3, 3]) @ T_CAM_VELO[:3, :3]
    frame = PointFrame(velo.astype(np.float32), T_CAM_VELO, P2, IMAGE_SIZE)
    cloud = viewed_cloud(frame)
    np.testing.assert_allclose(cloud.xyz, xyz[:1], atol=1e-6)
    u, v = cloud.pixels[0]
    for box, count in (((u, v, u + 1, v + 1), 1), ((u - 1, v - 1, u, v + 1), 0), ((u - 1, v - 1, u + 1, v), 0)):
        assert len(cut_frustum(cloud, Region("Car", box), P2, 3)[0].points) == count
    pixels = np.zeros(IMAGE_SIZE, bool)
    region = Region("Car", (0, 0, 5, 5), 1.0, pixels)
    assert len(cut_frustum(cloud, region, P2, 3)[0].points) == 0
    pixels[round(v), round(u)] = True
    assert len(cut_frustum(cloud, region, P2, 3)[0].points) == 1
    with pytest.raises(ValueError, match="take a network of 3 channels"):
        cut_frustum(cloud, region, P2, 4)


def test_small_boxes_and_empty_frustums_are_not_looked_into() -> None:
    frame, labels = box_frame(1, cars=1)
    frustum, _ = cut_frustum(viewed_cloud(frame), Region("Car", labels[0].bbox), P2, 4)
    x1, y1, x2, _ = labels[0].bbox
    assert is_looked_into(Region("Car", (x1, y1, x2, y1 + 25)), frustum)
    assert not is_looked_into(Region("Car", (x1, y1, x2, y1 + 24.9)), frustum)
    assert not is_looked_into(Region("Car", labels[0].bbox), replace(frustum, points=frustum.points[:4]))


def test_truth_of_a_sample_is_the_label_turned() -> None:
    frame, labels = box_frame(2, cars=3)
    for item, sample in zip(labels, frame_samples(frame, labels, 4)):
        rotation = frustum_rotation(item.bbox, P2)
        box = corners(boxes_of([item]))[0]
        np.testing.assert_allclose(sample.centre, rotate(box, rotation).mean(axis=0), atol=1e-9)
        # Direction of the front, from the heading in the turned frame and from the label.
        front = rotate(np.array([np.cos(item.ry), 0, -np.sin(item.ry)]), rotation)
        np.testing.assert_allclose([np.cos(sample.heading), -np.sin(sample.heading)], front[[0, 2]], atol=1e-9)
        assert sample.size.tolist() == [item.size[2], item.size[1], item.size[0]]
        assert sample.mask.sum() > 100
        radius = np.linalg.norm(sample.points[sample.mask, :3] - sample.centre, axis=1)
        assert radius.max() <= np.linalg.norm(sample.size) / 2 + 1e-3


def test_inside_a_box_by_its_corners() -> None:
    _, labels = box_frame(3, cars=1)
    box = corners(boxes_of(labels))[0]
    middle = box.mean(axis=0)
    assert inside_box(middle + 0.999 * (box - middle), labels[0]).all()
    assert not inside_box(middle + 1.001 * (box - middle), labels[0]).any()


def test_boxes_move_by_a_tenth() -> None:
    rng = np.random.default_rng(0)
    moved = np.array([moved_box((100, 50, 300, 150), rng) for _ in range(400)])
    centre = (moved[:, :2] + moved[:, 2:]) / 2
    size = moved[:, 2:] - moved[:, :2]
    assert np.abs(centre - (200, 100)).max(axis=0) == pytest.approx([20, 10], rel=0.05)
    assert size.min(axis=0) == pytest.approx([180, 90], rel=0.02)
    assert size.max(axis=0) == pytest.approx([220, 110], rel=0.02)


def test_copies_are_moved_and_useless_ones_left_out() -> None:
    frame, labels = box_frame(4, cars=1)
    assert len(frame_samples(frame, labels, 3, np.random.default_rng(0), copies=5)) == 5
    low = [replace(labels[0], bbox=(*labels[0].bbox[:3], labels[0].bbox[1] + 24))]
    assert frame_samples(frame, low, 3) == []
    elsewhere = [replace(labels[0], location=(0.0, -20.0, 15.0))]
    assert frame_samples(frame, elsewhere, 3) == []
    assert frame_samples(frame, labels, 3, classes=("Cyclist",)) == []


def test_two_flips_are_none() -> None:
    frame, labels = box_frame(5, cars=1)
    sample = frame_samples(frame, labels, 4)[0]
    once, twice = flipped(sample), flipped(flipped(sample))
    assert once.centre[0] == -sample.centre[0]
    assert twice.heading == pytest.approx(sample.heading)
    np.testing.assert_array_equal(twice.points, sample.points)


def test_shifts_along_the_frustum() -> None:
    centre, rng = np.array([0.3, 1.0, 30.0]), np.random.default_rng(0)
    intended = [depth_shift(centre, "intended", rng) for _ in range(300)]
    assert abs(float(np.mean(intended))) < 0.3
    assert float(np.std(intended)) == pytest.approx(1.5, rel=0.15)
    original = [depth_shift(centre, "original", rng) for _ in range(300)]
    across = np.hypot(0.3, 1.0)
    assert np.allclose(original, 0.8 * across)  # the draw never reaches 0.8: always away
    assert depth_shift(centre, "none", rng) == 0
    with pytest.raises(ValueError, match="expected one of intended, original, none"):
        depth_shift(centre, "sideways", rng)


def test_augmentation_moves_points_and_truth_together() -> None:
    frame, labels = box_frame(6, cars=1)
    sample = frame_samples(frame, labels, 3)[0]
    for seed in range(4):
        moved = augmented(sample, "intended", np.random.default_rng(seed))
        before = np.linalg.norm(sample.points - sample.centre, axis=1)
        np.testing.assert_allclose(np.linalg.norm(moved.points - moved.centre, axis=1), before, atol=1e-4)


def test_thinning_keeps_an_object_point() -> None:
    frame, labels = box_frame(7, cars=1)
    sample = frame_samples(frame, labels, 3)[0]
    lonely = replace(sample, mask=np.arange(len(sample.points)) == 5)
    small = thinned(lonely, 10, np.random.default_rng(0))
    assert len(small.points) == 10
    assert small.mask.any()
    np.testing.assert_array_equal(small.points[small.mask][0], sample.points[5])
