"""Augmentation moves points and boxes together, and pasted objects overlap nothing."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from detection.data_augmentation import (
    PasteSettings,
    SceneAugmentation,
    TrainingScene,
    augment_regions,
    augment_scene,
    cut_objects,
    disturb_points,
    flip_boxes,
    inside_box,
    paste_objects,
    rotate_about_y,
    scale_objects,
)
from detection.inputs import camera_cloud, ground_height, truth_boxes
from detection.models.box_coding import to_roi_frame
from detection.models.pointrcnn import canonical
from detection.ops import iou_3d
from tests.detection.scenes import box_frame


def scene(index: int, cars: int = 4) -> TrainingScene:
    frame, labels = box_frame(index, cars)
    cloud, truth = camera_cloud(frame), truth_boxes(labels, ("Car",))
    points = np.concatenate([cloud.xyz, cloud.columns], axis=1)
    return TrainingScene(points, ground_height(cloud.xyz), truth.boxes, truth.classes, truth.boxes)


def counts(value: TrainingScene) -> list[int]:
    grown = value.boxes + np.array([0, 0.01, 0, 0.02, 0.02, 0.02, 0])
    return [int(inside_box(value.points, box).sum()) for box in grown]


def test_rotation_and_flip_by_hand() -> None:
    turned = rotate_about_y(np.array([[1.0, 2.0, 0.0]]), np.pi / 2)
    np.testing.assert_allclose(turned, [[0, 2, -1]], atol=1e-12)
    boxes = np.array([[3.0, 1, 9, 1, 2, 4, 0.4], [3.0, 1, 9, 1, 2, 4, -0.4]])
    np.testing.assert_allclose(flip_boxes(boxes)[:, 6], [np.pi - 0.4, -np.pi + 0.4])
    assert flip_boxes(boxes)[:, 0].tolist() == [-3, -3]


def test_points_stay_in_their_boxes(rng) -> None:
    before = scene(1)
    for _ in range(4):
        after = augment_scene(before, SceneAugmentation(), rng)
        assert counts(after) == pytest.approx(counts(before), abs=3)
        assert np.abs(after.boxes[:, 6]).max() <= np.pi
    assert min(counts(before)) > 100


def test_no_augmentation_by_zero_settings(rng) -> None:
    before = scene(1)
    after = augment_scene(before, SceneAugmentation(0.0, 0.0, 0.0), rng)
    np.testing.assert_allclose(after.points, before.points, atol=1e-6)
    np.testing.assert_allclose(after.boxes, before.boxes, atol=1e-9)


def test_pasted_objects_stand_free_on_the_ground_with_their_points(rng) -> None:
    database = [item for index in range(2, 8) for item in cut_objects(scene(index))]
    assert len(database) > 15
    before = scene(1)
    after = paste_objects(before, database, PasteSettings(objects=(3, 3)), rng)
    assert len(after.boxes) == len(before.boxes) + 3 == len(after.classes)
    overlap = iou_3d(after.boxes, after.boxes) - np.eye(len(after.boxes))
    assert overlap.max() < 1e-8
    np.testing.assert_allclose(after.boxes[-3:, 1], 1.7, atol=0.05)
    assert len(after.points) == len(after.height)
    assert all(count >= 5 for count in counts(after))


def test_nothing_is_pasted_into_labelled_objects(rng) -> None:
    base = scene(1)
    database = cut_objects(base)  # every one collides with itself
    after = paste_objects(base, database, PasteSettings(), rng)
    assert len(after.boxes) == len(base.boxes)
    assert paste_objects(base, [], PasteSettings(), rng) is base


def test_roi_augmentation_keeps_what_the_network_sees_but_for_scale_and_mirror(rng) -> None:
    rois = torch.tensor([[[3.0, 1.5, 20.0, 1.5, 1.6, 4.0, 0.3]]], dtype=torch.float64)
    truth = rois + torch.tensor([0.3, 0.1, -0.2, 0.1, 0.1, 0.3, 0.1], dtype=torch.float64)
    pooled = torch.randn(1, 1, 16, 5, dtype=torch.float64)
    flips = 0
    for _ in range(20):
        points, moved, moved_truth = augment_regions(pooled, rois, truth, rng)
        before, after = canonical(pooled, rois), canonical(points, moved)
        scale = (moved[0, 0, 5] / rois[0, 0, 5]).item()
        assert 0.95 <= scale <= 1.05
        flipped = not torch.allclose(after[..., 2], before[..., 2] * scale, atol=1e-9)
        flips += flipped
        # A mirrored scene seen from the mirrored RoI: across changes sign, along stays.
        sign = torch.tensor([1.0, 1.0, -1.0 if flipped else 1.0], dtype=torch.float64)
        torch.testing.assert_close(after[..., :3], before[..., :3] * scale * sign)
        assert torch.equal(after[..., 3:], before[..., 3:])
        old, new = to_roi_frame(truth, rois)[0, 0], to_roi_frame(moved_truth, moved)[0, 0]
        torch.testing.assert_close(new[:3], old[:3] * scale * sign)
        assert torch.cos(new[6] - (-old[6] if flipped else old[6])).item() == pytest.approx(1.0)
    assert 3 <= flips <= 17


def test_scaled_object_by_hand() -> None:
    """A point near a corner of the roof stays there, points outside stay where they are."""
    box = np.array([10.0, 2, 20, 1.5, 1.6, 4, np.pi / 2])  # l along -z
    corner = [10 + 0.9 * 0.8, 2 - 0.9 * 1.5, 20 - 0.9 * 2.0]
    points = np.array([corner, [0, 2, 20]], dtype=np.float32)
    before = TrainingScene(points, np.array([1.35, 0], np.float32), box[None], np.array([1]), box[None])
    after = scale_objects(before, 0.2, np.random.default_rng(2))
    h, w, l = after.boxes[0, 3:6]
    assert min(abs(h / 1.5 - 1), abs(w / 1.6 - 1), abs(l / 4 - 1)) > 0.05
    np.testing.assert_allclose(after.points[0], [10 + 0.9 * w / 2, 2 - 0.9 * h, 20 - 0.9 * l / 2], atol=1e-5)
    np.testing.assert_allclose(after.points[1], points[1])
    np.testing.assert_allclose(after.height, [0.9 * h, 0], atol=1e-5)
    np.testing.assert_array_equal(before.points, points)


def test_disturbed_points_are_fewer_and_near(rng) -> None:
    before = scene(1)
    after = disturb_points(before, 0.0, 0.5, rng)
    assert len(before.points) * 0.45 < len(after.points) < len(before.points)
    noisy = disturb_points(before, 0.02, 0.0, rng)
    assert np.std(noisy.points[:, :3] - before.points[:, :3]) == pytest.approx(0.02, rel=0.05)
    assert len(after.height) == len(after.points)
