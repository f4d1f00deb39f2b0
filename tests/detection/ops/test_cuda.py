"""The same results on a GPU, where there is one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from detection.ops import ball_query, furthest_point_sample, iou_3d, nms_rotated, points_in_boxes, roi_pool, three_nn
from tests.detection.ops.test_pooling import scene

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


def test_devices_agree() -> None:
    cloud, features, boxes = (torch.from_numpy(np.asarray(part)) for part in scene(1, 2000, 20))
    centres = cloud[furthest_point_sample(cloud, 200)]
    c, f, b, p = (part.cuda() for part in (cloud, features, boxes, centres))
    scores = torch.linspace(0, 1, len(boxes))
    assert torch.equal(furthest_point_sample(c, 200).cpu(), furthest_point_sample(cloud, 200))
    assert torch.equal(ball_query(c, p, 0.5, 16).cpu(), ball_query(cloud, centres, 0.5, 16))
    assert torch.equal(three_nn(c, p)[1].cpu(), three_nn(cloud, centres)[1])
    assert torch.equal(points_in_boxes(c, b).cpu(), points_in_boxes(cloud, boxes))
    assert torch.equal(roi_pool(c, f, b, 0.2, 64)[0].cpu(), roi_pool(cloud, features, boxes, 0.2, 64)[0])
    assert torch.allclose(iou_3d(b, b).cpu(), iou_3d(boxes, boxes), atol=1e-6)
    assert torch.equal(nms_rotated(b, scores.cuda(), 0.1).cpu(), nms_rotated(boxes, scores, 0.1))
