"""Boxes, RoI targets and queries of the second stages; the border between camera and LiDAR frame."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from detection.lidar_inputs import (
    all_points,
    camera_axes_boxes,
    camera_axes_cloud,
    from_camera_axes,
    lidar_boxes,
    lidar_rows,
)
from detection.models.lidar_boxes import (
    limit_period,
    refined_boxes,
    residual_targets,
    to_camera_axes,
    to_lidar_axes,
)
from detection.models.lidar_rois import TrainingRois, roi_losses
from detection.models.presets import PRESETS
from detection.models.pv_rcnn import keypoint_labels
from detection.models.voxel_set_abstraction import in_balls, keypoints
from detection.ops import voxel_query as query_module
from detection.ops.sparse_conv import Sites
from detection.ops.voxel_query import voxel_query
from detection.ops.voxelize import VoxelGrid
from detection.training_batches import training_scene
from detection.types import PointFrame
from tests.detection.scenes import P2, box_frame

NUMBER = st.floats(-3, 3)
BOX = st.tuples(NUMBER, NUMBER, NUMBER, *[st.floats(0.3, 5)] * 3, st.floats(-6, 6))


@settings(max_examples=60, deadline=None)
@given(BOX, BOX)
def test_codes_lead_from_rois_to_the_truth_up_to_half_a_turn(roi, truth) -> None:
    rois, truths = torch.tensor([roi], dtype=torch.float64), torch.tensor([truth], dtype=torch.float64)
    code = residual_targets(rois, truths)
    assert abs(float(code[0, 6])) <= math.pi / 2 + 1e-9
    found = refined_boxes(rois, code)
    torch.testing.assert_close(found[:, :6], truths[:, :6], rtol=1e-6, atol=1e-6)
    assert abs(float(limit_period(found[:, 6] - truths[:, 6], 0.5, math.pi))) < 1e-6
    torch.testing.assert_close(to_lidar_axes(to_camera_axes(rois)), rois)


def test_roi_losses_by_hand() -> None:
    roi = torch.tensor([[5.0, 1, -1, 4, 2, 1.5, 0.3]]).repeat(3, 1)
    truth = roi.clone()
    truth[0, 2] += 0.3  # a fifth of the height
    chosen = TrainingRois(roi[None], truth[None], torch.tensor([[0.8, 0.5, 0.1]]))
    losses = roi_losses(chosen, 0.55, torch.zeros(3, 1), torch.zeros(3, 7))
    # Soft labels 1, 0.5, 0 all cost log 2 at probability one half; one RoI is foreground.
    assert float(losses["region_score"]) == pytest.approx(math.log(2))
    assert float(losses["region_box"]) == pytest.approx(0.2 - 1 / 18, rel=1e-4)
    assert float(losses["region_corner"]) == pytest.approx(0.5 * 0.3**2, rel=1e-4)


def test_rois_without_foreground_cost_no_box() -> None:
    roi = torch.tensor([[5.0, 1, -1, 4, 2, 1.5, 0.3]])
    code = torch.zeros(1, 7, requires_grad=True)
    losses = roi_losses(TrainingRois(roi[None], roi[None], torch.zeros(1, 1)), 0.55, torch.zeros(1, 1), code)
    assert losses["region_box"].item() == losses["region_corner"].item() == 0
    losses["region_box"].backward()
    assert not code.grad.any()


def test_numba_and_torch_find_the_same_voxels() -> None:
    generator = torch.Generator().manual_seed(0)
    grid = VoxelGrid((0, -2, -1), (4, 2, 1), (0.1, 0.1, 0.2), 5, (1, 1))
    cells = torch.randint(0, 2 * 5 * 20 * 20, (900,), generator=generator).unique()
    coords = torch.stack([cells // 2000, cells // 400 % 5, cells // 20 % 20, cells % 20], dim=1)
    sites = Sites(coords[torch.randperm(len(coords), generator=generator)], (5, 20, 20), 2)
    places = torch.rand(300, 3, generator=generator) * torch.tensor([5.0, 5, 3]) + torch.tensor([-0.5, -2.5, -1.5])
    frames = torch.arange(300) % 2
    ours = voxel_query(sites, grid, 2, places, frames, (2, 3, 4), 0.5, 4)
    low, size = torch.tensor(grid.low), torch.tensor(grid.size)
    index = ((places - low) / size).floor().long() // 2
    at = torch.cat([frames[:, None], index.flip(1)], dim=1)
    radius2 = float(np.float32(0.5) ** 2)
    theirs = query_module._query_torch(sites, places, at, (2, 3, 4), low, size * 2, radius2, 4)
    assert torch.equal(ours, theirs)
    assert (ours < 0).any()
    assert (sites.coords[ours[ours[:, 0] >= 0], 0] == frames[ours[:, 0] >= 0, None]).all()


def test_balls_tell_point_zero_from_none() -> None:
    sources = [torch.tensor([[0.0, 0, 0], [1, 0, 0]]), torch.zeros(0, 3), torch.tensor([[0.0, 0, 0]])]
    centres = torch.tensor([[[0.1, 0, 0], [5.0, 0, 0]]]).repeat(3, 1, 1)
    gather, offset = in_balls(sources, centres, 0.5, 2)
    assert gather.tolist() == [[0, 0], [3, 3], [3, 3], [3, 3], [2, 2], [3, 3]]
    assert offset[0].tolist() == [pytest.approx([-0.1, 0, 0])] * 2
    assert not offset[1:4].any()


def test_keypoints_repeat_in_turn_and_labels_have_a_thin_ring() -> None:
    xyz = torch.tensor([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
    assert keypoints(xyz, 5)[:, 0].tolist() == [0, 5, 1, 0, 5]
    with pytest.raises(ValueError, match="at least one point"):
        keypoints(xyz[:0], 5)
    box = torch.tensor([[5.0, 2, -1, 4, 2, 1.5, 0]])
    points = torch.tensor([[[6.9, 2, -1], [7.05, 2, -1], [7.15, 2, -1], [5, 2, -1.84]]])
    assert keypoint_labels(points, [box]).tolist() == [[1, -1, 0, -1]]


def tilted() -> PointFrame:
    """A frame whose camera is turned and moved against the LiDAR."""
    frame, _ = box_frame(0)
    angle = 0.02
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    T = frame.T_cam_velo.copy()
    T[:3, :3], T[:3, 3] = turn @ T[:3, :3], (0.1, -0.08, -0.27)
    return PointFrame(frame.points, T, P2, frame.image_size, frame.id)


def test_boxes_cross_the_border_and_come_back() -> None:
    frame, rng = tilted(), np.random.default_rng(0)
    boxes = np.column_stack([rng.uniform(-9, 9, (6, 3)), rng.uniform(1, 4, (6, 3)), rng.uniform(-3, 3, 6)])
    turned = camera_axes_boxes(boxes, frame)
    np.testing.assert_allclose(from_camera_axes(turned, frame).values, boxes, atol=1e-9)
    lidar = lidar_boxes(turned)
    np.testing.assert_allclose(to_lidar_axes(torch.from_numpy(turned))[:, :6].numpy(), lidar[:, :6], atol=1e-9)
    # heading = -(ry + pi / 2), and the centre lies half the height above the bottom.
    np.testing.assert_allclose(np.cos(lidar[:, 6] + boxes[:, 6] + np.pi / 2), 1, atol=1e-9)
    centre = np.column_stack([lidar[:, :3], np.ones(6)]) @ frame.T_cam_velo.T
    np.testing.assert_allclose(centre[:, :3], boxes[:, :3] - np.outer(boxes[:, 3] / 2, [0, 1, 0]), atol=0.05)


def test_points_keep_their_place_and_order_and_boxes_hold_the_same_points() -> None:
    frame, labels = box_frame(3)
    rows = all_points(frame, ("intensity",))
    index = {tuple(row): i for i, row in enumerate(frame.points.tolist())}
    places = [index[tuple(row)] for row in rows.tolist()]
    assert places == sorted(places)
    assert len(rows) > 3000
    scene = training_scene(frame, labels, PRESETS["second_small"]())
    cloud = camera_axes_cloud(frame)
    np.testing.assert_array_equal(lidar_rows(cloud, scene.height, ("intensity",)), rows)
    for x, y, z, l, w, h, heading in lidar_boxes(scene.boxes).tolist():
        cos, sin = math.cos(heading), math.sin(heading)
        dx, dy = rows[:, 0] - x, rows[:, 1] - y
        a, b = dx * cos + dy * sin, dy * cos - dx * sin
        inside = (np.abs(a) <= l / 2 + 0.01) & (np.abs(b) <= w / 2 + 0.01) & (np.abs(rows[:, 2] - z) <= h / 2 + 0.01)
        assert inside.sum() >= 250
    with pytest.raises(ValueError, match="'source'"):
        all_points(frame, ("intensity", "source"))
