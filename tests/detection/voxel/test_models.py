"""The networks against twins written the long way, at every stage, and their published sizes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from detection.models.anchor_head import KITTI_ANCHORS
from detection.models.lidar_boxes import roi_grid_points
from detection.models.presets import PRESETS
from detection.models.voxel_backbone import VoxelLevels, mean_voxels
from detection.models.voxel_set_abstraction import read_map
from detection.ops.voxelize import VoxelGrid
from tests.detection.voxel import tiny
from tests.reference import voxel_twin as twin
from tests.reference.voxel_sparse import voxelize_loop

ANCHORS = [(kind.size, kind.bottom) for kind in KITTI_ANCHORS]
ROIS = torch.tensor([[1.23, 0.14, -1.03, 1.5, 1.0, 1.2, 0.4], [2.63, -1.04, -1.97, 1.8, 0.8, 1.0, -2.0]])
close = torch.testing.assert_close


def crop(points: Tensor) -> Tensor:
    low, high = torch.tensor(tiny.LOW[:2]), torch.tensor(tiny.HIGH[:2])
    return points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(dim=1)]


def voxel_rows(points: Tensor, grid: VoxelGrid) -> tuple[list[tuple[int, int, int]], list[list[list[float]]]]:
    return voxelize_loop(points.tolist(), grid.low, grid.size, grid.shape, grid.max_points, grid.max_voxels[1])


def dense_input(points: Tensor) -> tuple[Tensor, Tensor]:
    """Mean of the points per voxel as (1, 4, 41, 32, 32), and its mask."""
    dense, mask = torch.zeros(1, 4, 41, 32, 32), torch.zeros(1, 1, 41, 32, 32)
    for (z, y, x), members in zip(*voxel_rows(points, tiny.VOXELS)):
        dense[0, :, z, y, x] = torch.tensor(members).mean(dim=0)
        mask[0, 0, z, y, x] = 1
    return dense, mask


@pytest.mark.parametrize(
    ("name", "parameters", "entries"),
    [
        ("pointpillars", 4834888, 127),
        ("second", 5325576, 163),
        ("voxel_rcnn", 7586620, 257),
        ("pv_rcnn", 13115697, 367),
    ],
)
def test_published_sizes(name, parameters, entries) -> None:
    model = PRESETS[name]().build()
    assert sum(parameter.numel() for parameter in model.parameters()) == parameters
    assert len(model.state_dict()) == entries


@pytest.mark.parametrize("name", [name for name in PRESETS if name.endswith("_small")])
def test_small_presets_take_extra_point_columns(name) -> None:
    preset = PRESETS[name](features=["intensity", "source"], classes=["Car"])
    again = PRESETS[preset.name](**preset.options)
    assert again.inputs == preset.inputs
    assert preset.classes == ("Car",)
    assert sum(parameter.numel() for parameter in preset.build().parameters()) < 2e6
    with pytest.raises(ValueError, match="expected some of Car, Pedestrian, Cyclist, got Tram"):
        PRESETS[name](classes=["Tram"])


def test_every_normalisation_has_the_reference_constants() -> None:
    for name in ("pointpillars", "pv_rcnn", "voxel_rcnn"):
        for path, module in PRESETS[name]().build().named_modules():
            if isinstance(module, nn.modules.batchnorm._BatchNorm):
                is_voxel = path.startswith(("vfe", "backbone"))
                assert (module.eps, module.momentum) == ((1e-3, 0.01) if is_voxel else (1e-5, 0.1)), path


@torch.no_grad()
def test_pointpillars_equals_its_twin() -> None:
    model, points = tiny.tiny_pillars(), tiny.cloud()
    state = model.state_dict()
    out = model([points])
    expected = torch.zeros(1, 8, 16, 16)
    coords, members = voxel_rows(points, tiny.PILLARS)
    for (_, y, x), rows in zip(coords, members):
        centre = (0.2 * (x + 0.5), -1.6 + 0.2 * (y + 0.5), -1.0)
        expected[0, :, y, x] = twin.pillar_features(state, rows, centre, 6)
    close(out.spatial_features, expected, rtol=1e-4, atol=1e-5)
    bev = twin.bev_backbone(state, expected, (1, 2), (2, 2))
    close(out.bev, bev, rtol=1e-4, atol=1e-5)
    scores, boxes = twin.decoded_anchors(state, bev, ANCHORS, tiny.LOW, tiny.HIGH)
    np.testing.assert_allclose(out.head.cls[0], scores, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(out.boxes[0], boxes, rtol=1e-4, atol=1e-4)
    assert len(np.unique(out.head.direction[0].argmax(dim=1))) == 2


@torch.no_grad()
def test_second_equals_its_twin_frame_by_frame() -> None:
    model, clouds = tiny.tiny_second(), [tiny.cloud(), tiny.cloud(seed=2)]
    state = model.state_dict()
    levels, out = model.first_stage(clouds)
    for b, points in enumerate(clouds):
        expected, spatial = twin.sparse_backbone(state, *dense_input(points))
        for ours, (dense, mask) in zip(levels.levels, expected):
            close(ours.dense()[b], dense[0], rtol=1e-4, atol=1e-5)
            own = ours.sites.coords[ours.sites.coords[:, 0] == b, 1:]
            assert sorted(map(tuple, own.tolist())) == sorted(map(tuple, mask[0, 0].nonzero().tolist()))
        close(out.spatial_features[b], spatial[0], rtol=1e-4, atol=1e-5)
        bev = twin.bev_backbone(state, spatial, (1, 2), (1, 2))
        scores, boxes = twin.decoded_anchors(state, bev, ANCHORS, tiny.LOW, tiny.HIGH)
        np.testing.assert_allclose(out.head.cls[b], scores, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(out.boxes[b], boxes, rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_voxel_rcnn_second_stage_equals_its_twin() -> None:
    model, points = tiny.tiny_voxel_rcnn(), tiny.cloud()
    state, head = model.state_dict(), model.roi_head
    levels, _ = model.first_stage([points])
    expected, _ = twin.sparse_backbone(state, *dense_input(points))
    logits, code = head(levels, ROIS[None])
    places = [place for roi in ROIS.tolist() for place in twin.grid_points(roi, 3)]
    close(roi_grid_points(ROIS, 3).view(-1, 3), torch.tensor(places), rtol=1e-5, atol=1e-5)
    pooled = [
        twin.voxel_pool(
            state, f"roi_head.roi_grid_pool_layers.{k}", expected[k + 1], places, tiny.LOW, (0.1,) * 3, 2 << k, radius
        )
        for k, radius in enumerate((0.4, 0.8, 1.6))
    ]
    rows = torch.cat(pooled, dim=1).view(2, 27, 15)
    close(head.pool(levels, ROIS[None]), rows, rtol=1e-4, atol=1e-5)
    shared = twin.layers(state, "roi_head.shared_fc_layer", rows.flatten(1), (0, 4))
    cls = twin.layers(state, "roi_head.cls_fc_layers", shared, (0, 4))
    reg = twin.layers(state, "roi_head.reg_fc_layers", shared, (0, 4))
    reg = reg @ state["roi_head.reg_pred_layer.weight"].T + state["roi_head.reg_pred_layer.bias"]
    close(logits, cls @ state["roi_head.cls_pred_layer.weight"].T + state["roi_head.cls_pred_layer.bias"])
    close(code, reg, rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_pv_rcnn_keypoints_and_second_stage_equal_their_twins() -> None:
    model, points = tiny.tiny_pv_rcnn(), crop(tiny.cloud())
    state = model.state_dict()
    _, found, logits = model.scene([points])
    expected, spatial = twin.sparse_backbone(state, *dense_input(points))
    keys = found.xyz[0]
    assert torch.equal(keys[0], points[0, :3])
    columns = [torch.stack([twin.map_value(spatial[0], x / 0.8, (y + 1.6) / 0.8) for x, y, _ in keys.tolist()])]
    columns.append(twin.ball_pool(state, "pfe.SA_rawpoints", points[:, :3], points[:, 3:], keys, (0.2, 0.8), (4, 8)))
    first, _ = voxel_rows(points, tiny.VOXELS)
    for k, (dense, mask) in enumerate(expected):
        # x_conv1 keeps the order of the voxels, coarser levels are sorted by z, y, x.
        coords = torch.tensor(first) if k == 0 else mask[0, 0].nonzero()
        centres = (coords.flip(1) + 0.5) * 0.1 * 2**k + torch.tensor(tiny.LOW)
        values = dense[0][:, coords[:, 0], coords[:, 1], coords[:, 2]].T
        spec = tiny.KEYPOINTS.levels[k]
        columns.append(twin.ball_pool(state, f"pfe.SA_layers.{k}", centres, values, keys, spec.radii, spec.neighbours))
    gathered = torch.cat(columns, dim=1)
    close(found.gathered, gathered, rtol=1e-4, atol=1e-5)
    fused = twin.layers(state, "pfe.vsa_point_feature_fusion", gathered, (0,))
    close(found.features, fused, rtol=1e-4, atol=1e-5)
    scores = twin.layers(state, "point_head.cls_layers", gathered, (0, 3, 6))
    close(logits, scores, rtol=1e-4, atol=1e-5)
    places = torch.tensor([place for roi in ROIS.tolist() for place in twin.grid_points(roi, 3)])
    weighted = fused * scores.sigmoid()
    pooled = twin.ball_pool(state, "roi_head.roi_grid_pool_layer", keys, weighted, places, (0.4, 0.8), (4, 6))
    rows = pooled.view(2, 27, 12).transpose(1, 2).reshape(2, -1)
    shared = twin.layers(state, "roi_head.shared_fc_layer", rows, (0, 4))
    ours = model.roi_head(found, logits.sigmoid(), ROIS[None])
    for kind, values in zip(("cls", "reg"), ours):
        close(values, twin.layers(state, f"roi_head.{kind}_layers", shared, (0, 4, 7)), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("build", [tiny.tiny_voxel_rcnn, tiny.tiny_pv_rcnn])
@torch.no_grad()
def test_refined_boxes_follow_from_rois_and_codes(build) -> None:
    out = build()([tiny.cloud(), tiny.cloud(seed=2)])
    assert out.proposals.rois.shape == (2, 6, 7)
    for b in range(2):
        valid = out.proposals.valid[b]
        rois, codes = out.proposals.rois[b, valid].tolist(), out.refined.reg[b, valid].tolist()
        expected = torch.tensor([twin.refined(roi, code) for roi, code in zip(rois, codes)])
        close(out.refined.boxes[b, valid], expected, rtol=1e-4, atol=1e-4)
        best = out.first.head.cls[b].max(dim=1)
        assert out.proposals.scores[b, 0] == best.values.max()
        assert torch.equal(out.refined.labels[b, valid], best.indices[out.proposals.index[b, valid]])
        close(out.proposals.rois[b, valid], out.first.boxes[b, out.proposals.index[b, valid]])


def test_map_values_vanish_beyond_the_last_column_as_in_the_reference() -> None:
    bev = torch.arange(6.0).view(1, 2, 3) + 1
    places = torch.tensor([[0.5, 0.0], [1.0, 0.5], [2.0, 0.0], [2.5, 0.0], [0.0, 1.0]])
    assert read_map(bev, places)[:, 0].tolist() == [1.5, 3.5, 0.0, 0.0, 0.0]


def test_an_empty_grid_gives_an_empty_map() -> None:
    high_above = torch.tensor([[1.0, 0.0, 5.0, 0.5]])
    voxels = mean_voxels([high_above], tiny.VOXELS, 10)
    assert len(voxels.sites) == 0
    levels: VoxelLevels = tiny.tiny_second().backbone_3d(voxels)
    assert not levels.bev.any()
    assert not tiny.tiny_pillars().vfe([high_above]).any()
