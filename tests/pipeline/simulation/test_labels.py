"""Labels: boxes round their points and masks, truncation, occlusion, who gets a line."""

from __future__ import annotations

import numpy as np
import pytest

from detection.boxes import project_to_image
from detection.kitti_format import KittiObject, boxes_of
from pipeline.simulation.labels import LabelRule, ObjectTruth, kitti_labels, occlusion_level
from pipeline.simulation.statistics import points_in_box
from pipeline.simulation.synth import SyntheticFrame


def _iou(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    wide, high = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    shared = max(wide, 0) * max(high, 0)
    return shared / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - shared)


def _mask_box(mask: np.ndarray) -> tuple[float, float, float, float]:
    """Outer edges of the mask's pixels, pixel centres at integers."""
    v, u = np.nonzero(mask)
    return float(u.min()) - 0.5, float(v.min()) - 0.5, float(u.max()) + 0.5, float(v.max()) + 0.5


def _as_object(truth: ObjectTruth) -> KittiObject:
    x, y, z, h, w, l, ry = truth.box
    return KittiObject(truth.label, 0, 0, 0, (0, 0, 1, 1), (h, w, l), (x, y, z), ry)


def test_label_boxes_agree_with_the_masks(full_frame: SyntheticFrame, frames: list[SyntheticFrame]) -> None:
    flat, solid = [], []
    for frame in [full_frame, *frames]:
        unhidden = {t.instance: t for t in frame.truths if t.occlusion < 0.02 and t.truncation < 0.01}
        for label in frame.labels:
            chosen = [t for t in unhidden.values() if np.allclose(t.box[:3], label.location, atol=0.01)]
            if label.type in ("Car", "Van") and label.height_2d > 20 and chosen:
                mask = _mask_box(frame.instances == chosen[0].instance)
                flat.append(_iou(mask, label.bbox))
                box = project_to_image(boxes_of([label]), frame.calibration.P2, frame.depth.shape)[0]
                solid.append(_iou(mask, tuple(box)))
    assert len(flat) >= 4
    assert min(flat) > 0.9
    # The cuboid of the 3D box is larger than the rounded car that fills it: about 3 % of its size on each side.
    assert np.mean(solid) > 0.85


def test_boxes_contain_the_points_of_their_car(full_frame: SyntheticFrame) -> None:
    frame = full_frame
    camera = frame.calibration.velo_to_cam(frame.points)
    pixels, z = frame.calibration.cam_to_image(camera)
    u, v = np.rint(pixels).clip(-1, 1e6).astype(int).T
    height, width = frame.depth.shape
    seen = (z > 0.5) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    owner, depth = np.zeros(len(z), dtype=int), np.zeros(len(z))
    owner[seen], depth[seen] = frame.instances[v[seen], u[seen]], frame.depth[v[seen], u[seen]]
    shares = []
    for truth in frame.truths:
        own = (owner == truth.instance) & (np.abs(z - depth) < 0.3)
        if truth.label == "Car" and own.sum() > 20:
            shares.append(points_in_box(camera, _as_object(truth), 0.05)[own].mean())
    assert len(shares) >= 3
    assert min(shares) > 0.95


def test_unhidden_things_show_all_their_pixels(frames: list[SyntheticFrame]) -> None:
    shares = [
        t.visible_pixels / t.amodal_pixels
        for f in frames
        for t in f.truths
        if 0 <= t.occlusion < 0.5 and t.amodal_pixels
    ]
    assert max(shares) == pytest.approx(1.0, abs=0.02)
    for frame in frames:
        for truth in frame.truths:
            # Ray casting and rasterising differ on a few border pixels only.
            assert truth.visible_pixels <= 1.05 * truth.amodal_pixels + 6
            assert truth.visible_pixels == (frame.instances == truth.instance).sum()
            assert 0 <= truth.truncation <= 1


@pytest.mark.parametrize(("hidden", "level"), [(0.0, 0), (0.19, 0), (0.3, 1), (0.7, 2), (0.95, 3)])
def test_occlusion_levels(hidden: float, level: int) -> None:
    assert occlusion_level(hidden) == level


def _truth(**changes: object) -> ObjectTruth:
    values: dict[str, object] = {
        "instance": 1, "label": "Car", "box": np.array([3.0, 1.6, 10.0, 1.5, 1.6, 4.0, -1.57]), "visible_pixels": 900,
        "amodal_pixels": 1000, "amodal_bounds": (-20.0, 40.0, 60.0, 80.0), "truncation": 0.25, "occlusion": 0.1,
        "speed": 0.0,
    }  # fmt: skip
    return ObjectTruth(**{**values, **changes})  # type: ignore[arg-type]


def test_label_line_of_a_truncated_car() -> None:
    (label,) = kitti_labels([_truth()], (100, 200))
    assert (label.type, label.truncated, label.occluded) == ("Car", 0.25, 0)
    assert label.bbox == (0.0, 40.0, 60.0, 80.0)
    assert label.size == (1.5, 1.6, 4.0)
    assert label.location == (3.0, 1.6, 10.0)
    # alpha = ry - atan2(x, z) = -1.57 - 0.29146
    assert label.alpha == pytest.approx(-1.86146, abs=1e-4)


def test_small_hidden_and_far_things_become_dont_care_or_nothing() -> None:
    small = _truth(amodal_bounds=(10.0, 40.0, 30.0, 50.0), visible_pixels=60)
    far = _truth(box=np.array([3.0, 1.6, 90.0, 1.5, 1.6, 4.0, 0.0]))
    invisible = _truth(visible_pixels=0, occlusion=1.0)
    labels = kitti_labels([small, far, invisible, _truth()], (100, 200))
    assert [item.type for item in labels] == ["Car", "DontCare", "DontCare"]
    assert labels[1].location == (-1000.0, -1000.0, -1000.0)
    assert kitti_labels([small], (100, 200), LabelRule(min_height=8))[0].type == "Car"
