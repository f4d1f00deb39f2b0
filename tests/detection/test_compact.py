"""The small detector: its second-stage code, its regions and its losses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from detection.models.added_classes import with_classes
from detection.models.batch import PointBatch
from detection.models.compact import (
    CompactPointRCNN,
    CompactSettings,
    Regions,
    refined_boxes,
    residual_targets,
)
from detection.models.layers import PointLayer
from detection.models.presets import small
from detection.ops import iou_3d_aligned
from tests.detection.scenes import place_cars


def tiny() -> CompactPointRCNN:
    torch.manual_seed(0)
    return CompactPointRCNN(CompactSettings().widened(0.25))


def test_second_stage_code_by_hand() -> None:
    # RoI heading 90 degrees: its x axis points to -z of the scene; l = 4, w = 3, diagonal 5.
    roi = torch.tensor([[5.0, 1.0, 20.0, 1.5, 3.0, 4.0, math.pi / 2]], dtype=torch.float64)
    truth = torch.tensor([[5.5, 1.3, 19.0, 1.5, 3.0, 8.0, math.pi / 2 + 0.1]], dtype=torch.float64)
    code = residual_targets(roi, truth)
    # 1 m ahead = 0.2 diagonals, 0.5 m to its +z (scene +x), centre 0.3 m lower of 1.5 m, twice as long.
    assert code[0].tolist() == pytest.approx([0.2, 0.1, 0.2, math.log(2), 0.0, 0.0, 0.1])
    torch.testing.assert_close(refined_boxes(roi, code), truth)


def test_code_returns_every_box_up_to_a_half_turn(rng) -> None:
    truth = torch.tensor(place_cars(12, rng, farthest=60))
    rois = truth + torch.tensor(rng.normal(0, 0.2, (12, 7)))
    rois[::2, 6] += math.pi
    again = refined_boxes(rois, residual_targets(rois, truth))
    np.testing.assert_allclose(iou_3d_aligned(again.numpy(), truth.numpy()), 1.0, atol=1e-9)
    # The turned RoIs keep their own direction.
    assert (again[::2, 6] - truth[::2, 6]).cos().max() < -0.99


def test_widths_scale_in_eights() -> None:
    assert CompactSettings().widened(0.5).propagation == ((32, 32), (48, 48), (80, 64))
    assert CompactSettings().widened(1.0) == CompactSettings()
    parameters = sum(p.numel() for p in small().build().parameters())
    assert 200_000 < parameters < 500_000


def batch(model: CompactPointRCNN, boxes: torch.Tensor, seed: int = 0) -> PointBatch:
    generator = torch.Generator().manual_seed(seed)
    cloud = torch.rand(600, 5, generator=generator) * torch.tensor([20.0, 2, 30, 1, 1]) - torch.tensor(
        [10.0, 0.5, -5, 0, 0]
    )
    classes = torch.ones(len(boxes), dtype=torch.long)
    return PointBatch(cloud[None, :400], [cloud], [boxes], [classes])


def test_every_parameter_learns_and_stages_do_not_mix() -> None:
    model = tiny().train()
    boxes = torch.tensor([[0.0, 1.5, 20.0, 2.0, 4.0, 6.0, 0.3]])
    model.training_losses(batch(model, boxes), np.random.default_rng(0))["loss"].backward()
    assert [name for name, p in model.named_parameters() if p.grad is None] == []
    model.zero_grad()
    losses = model.training_losses(batch(model, boxes), np.random.default_rng(0))
    (losses["region_score"] + losses["region_box"] + losses["region_corner"]).backward()
    assert all(p.grad is None for p in model.points.parameters())


def test_a_frame_without_boxes_trains_the_scores_only() -> None:
    model = tiny().train()
    losses = model.training_losses(batch(model, torch.zeros(0, 7)), np.random.default_rng(0))
    assert losses["point_box"].item() == losses["region_box"].item() == losses["region_corner"].item() == 0
    assert losses["point_class"].item() > 0
    assert losses["region_score"].item() > 0
    losses["loss"].backward()


def test_regions_far_from_every_point_give_finite_boxes() -> None:
    model = tiny().eval()
    rois = torch.tensor([[500.0, 1.5, 20.0, 1.5, 1.6, 3.9, 0.0]])
    features = torch.zeros(1, model.points.backbone.out_channels)
    regions = Regions(rois, torch.zeros(1, dtype=torch.long), features, torch.zeros(1))
    with torch.no_grad():
        logits, code = model.regions(torch.rand(50, 5), regions)
    assert bool(torch.isfinite(logits).all())
    assert bool(torch.isfinite(code).all())


def test_the_second_stage_sees_points_the_first_did_not() -> None:
    model = tiny().eval()
    frame = batch(model, torch.zeros(0, 7))
    with torch.no_grad():
        sampled_only = model.raw_detections(replace(frame, clouds=[frame.points[0]]))[0]
        whole = model.raw_detections(frame)[0]
    assert len(sampled_only.boxes) == len(whole.boxes)
    assert not torch.equal(sampled_only.logits, whole.logits)


def test_box_head_has_no_batch_normalisation() -> None:
    # It sees foreground points in training and likely ones in detection: their statistics differ.
    head = tiny().points.box_hidden
    assert isinstance(head, PointLayer)
    assert head.bn is None


def test_an_added_class_starts_as_a_copy_of_the_one_it_counts_as() -> None:
    """Old classes keep their scores, vans get those of cars, and a region of a car is refined as before."""
    torch.manual_seed(2)
    old = small(points=512, width=0.5).build().eval()
    classes = ("Car", "Van", "Pedestrian", "Cyclist")
    new = with_classes(old, classes).eval()
    cloud = torch.cat([torch.rand(1, 512, 3) * torch.tensor([20.0, 2.0, 40.0]), torch.zeros(1, 512, 2)], dim=2)
    with torch.no_grad():
        before, after = old.points(cloud).logits, new.points(cloud).logits
        torch.testing.assert_close(after, before[..., [0, 0, 1, 2]])
        features = torch.randn(2, old.points.backbone.out_channels)
        rois = torch.tensor([[10.0, 1.5, 20, 1.5, 1.6, 4, 0.3]] * 2)
        found = old.regions(cloud[0], Regions(rois, torch.tensor([0, 2]), features, torch.zeros(2)))
        same = new.regions(cloud[0], Regions(rois, torch.tensor([1, 3]), features, torch.zeros(2)))
    torch.testing.assert_close(same, found)
    with pytest.raises(ValueError, match="nothing to start Tram"):
        with_classes(old, ("Car", "Tram"))
