from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from detection.frustum.coding import CLUSTERS, encode_heading, encode_size
from detection.frustum.frustums import frustum_rotation, rotate
from detection.frustum.infer import FrustumDetector, decode
from detection.frustum.network import FrustumOutput, FrustumPointNet
from detection.frustum.regions import Region, object_regions
from detection.kitti_format import KittiObject, format_line, parse_line
from tests.detection.scenes import P2, box_frame


class Oracle(nn.Module):
    """Says the labels' boxes in the order of the frustums."""

    channels = 3

    def __init__(self, labels: list[KittiObject]) -> None:
        super().__init__()
        self.labels = labels

    def forward(self, points: Tensor, one_hot: Tensor, rng: np.random.Generator) -> FrustumOutput:
        box = torch.zeros(len(points), 59)
        first = torch.zeros(len(points), 3)
        for row, (item, hot) in enumerate(zip(self.labels, one_hot)):
            rotation = frustum_rotation(item.bbox, P2)
            height, width, length = item.size
            assert hot.tolist() == [1, 0, 0]
            cluster = CLUSTERS.index("Car")
            bins, residual = encode_heading(np.array([item.ry - rotation]))
            size = encode_size(np.array([[length, width, height]]), np.array([cluster]))
            first[row] = torch.from_numpy(rotate(np.array(item.location) - (0, height / 2, 0), rotation)).float() - 1
            box[row, :3] = 1
            box[row, 3 + int(bins[0])] = 9.0
            box[row, 15 + int(bins[0])] = float(residual[0]) / (np.pi / 12)
            box[row, 27 + cluster] = 9.0
            units = size[0] / np.array([3.88311640418, 1.62856739989, 1.52563191462])
            box[row, 35 + 3 * cluster : 38 + 3 * cluster] = torch.from_numpy(units).float()
        logits = torch.zeros(len(points), points.shape[1], 2)
        logits[..., 1] = 2.0
        return FrustumOutput(logits, logits[..., 1] > 0, first, first, box)


def detector(model: nn.Module) -> FrustumDetector:
    return FrustumDetector(model, torch.device("cpu"), points=32)  # type: ignore[arg-type]


def test_boxes_come_back_as_the_labels() -> None:
    frame, labels = box_frame(0, cars=4)
    found = detector(Oracle(labels)).detect(frame, object_regions(labels))
    assert len(found) == 4
    for mine, item in zip(found, labels):
        np.testing.assert_allclose(mine.location, item.location, atol=1e-5)
        np.testing.assert_allclose(mine.size, item.size, atol=1e-5)
        assert abs(np.exp(1j * (mine.ry - item.ry)) - 1) < 1e-5
        assert (mine.type, mine.truncated, mine.occluded, mine.alpha) == ("Car", -1, -1, -10)
        assert parse_line(format_line(mine), scored=True).type == "Car"


def test_the_own_score_is_the_published_sum_of_logarithms() -> None:
    frame, labels = box_frame(0, cars=1)
    (found,) = detector(Oracle(labels)).detect(frame, object_regions(labels))
    mask, heading, size = 1 / (1 + np.exp(-2)), 1 / (1 + 11 * np.exp(-9)), 1 / (1 + 7 * np.exp(-9))
    assert found.score == pytest.approx(np.log(mask) + np.log(heading) + np.log(size), abs=1e-5)
    (scored,) = detector(Oracle(labels)).detect(frame, [Region("Car", labels[0].bbox, 0.37)])
    assert scored.score == 0.37


def test_an_empty_mask_still_has_a_finite_score() -> None:
    zero = torch.zeros(1, 3)
    boxes = decode(FrustumOutput(torch.zeros(1, 5, 2), torch.zeros(1, 5) > 0, zero, zero, torch.zeros(1, 59)))
    assert boxes.own_score[0] == pytest.approx(np.log(1e-12) - np.log(12) - np.log(8), rel=1e-5)


def test_low_boxes_and_empty_ones_give_nothing_and_boxes_are_clipped() -> None:
    frame, labels = box_frame(1, cars=1)
    x1, y1, x2, y2 = labels[0].bbox
    regions = [
        Region("Car", (x1, y1, x2, y1 + 20), 0.9),
        Region("Car", (5.0, 5.0, 60.0, 60.0), 0.9),  # sky
        Region("Car", (-7.0, y1, 2000.0, y2), 0.5),
    ]
    (found,) = detector(Oracle(labels)).detect(frame, regions)
    assert found.bbox == (0.0, y1, 1241.0, y2)
    assert detector(Oracle(labels)).detect(frame, []) == []


def test_the_same_frame_gives_the_same_boxes() -> None:
    frame, labels = box_frame(2, cars=3)
    torch.manual_seed(1)
    network = detector(FrustumPointNet("tf", 4).eval())
    first, again = (network.detect(frame, object_regions(labels)) for _ in range(2))
    assert first == again
    other = replace(network, seed=1).detect(frame, object_regions(labels))
    assert [item.location for item in other] != [item.location for item in first]


def test_a_class_changes_the_box() -> None:
    frame, labels = box_frame(3, cars=1)
    torch.manual_seed(1)
    network = detector(FrustumPointNet("port", 3).eval())
    found = [network.detect(frame, [Region(kind, labels[0].bbox, 1.0)])[0] for kind in ("Car", "Pedestrian")]
    assert found[0].location != found[1].location
