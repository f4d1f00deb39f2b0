"""Detecting: the same frame gives the same boxes, and the last steps from raw boxes to detections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from detection.checkpoints import load_checkpoint, save_checkpoint
from detection.infer import Detector, final_detections, imported_detector, load_detector, vote
from detection.models.batch import RawDetections
from detection.models.openpcdet_pointrcnn import OpenPCDetPointRCNN
from detection.models.presets import IMPORTED_PRESETS, OutputSettings, small
from detection.types import PointFrame
from tests.detection.scenes import IMAGE_SIZE, P2, T_CAM_VELO, box_frame

CAR = [2.0, 1.7, 20.0, 1.5, 1.6, 4.0, 0.3]


@pytest.fixture(scope="module")
def detector(tmp_path_factory) -> Detector:
    preset = small(points=512, width=0.25)
    torch.manual_seed(0)
    path = save_checkpoint(preset.build(), preset, tmp_path_factory.mktemp("weights") / "a.safetensors", {})
    loaded = load_detector(path)
    # An untrained network is sure of nothing; take every box.
    return replace(loaded, preset=replace(loaded.preset, outputs=replace(loaded.preset.outputs, score_threshold=0.0)))


def test_a_frame_s_detections_depend_on_seed_and_id_only(detector) -> None:
    frame = box_frame(0)[0]
    first, again = detector.detect(frame), detector.detect(frame)
    assert len(first) > 0
    assert np.array_equal(first.boxes.values, again.boxes.values)
    assert np.array_equal(first.scores, again.scores)
    assert (np.diff(first.scores) <= 0).all()
    other = replace(detector, seed=1).detect(frame)
    renamed = detector.detect(replace(frame, id="another"))
    for different in (other, renamed):
        assert not np.array_equal(first.scores, different.scores)


def test_nothing_visible_means_nothing_found(detector) -> None:
    behind = PointFrame(np.full((5, 4), -10, np.float32), T_CAM_VELO, P2, IMAGE_SIZE, "behind")
    assert len(detector.detect(behind)) == 0
    none = PointFrame(np.zeros((0, 4), np.float32), T_CAM_VELO, P2, IMAGE_SIZE, "none")
    assert len(detector.detect(none)) == 0


def test_one_visible_point_is_enough(detector) -> None:
    found = detector.detect(PointFrame(np.array([[20, 0, -1, 0.5]], np.float32), T_CAM_VELO, P2, IMAGE_SIZE, "one"))
    assert np.isfinite(found.boxes.values).all()
    assert len(found.scores) == len(found.classes) == len(found)


def test_missing_columns_are_named() -> None:
    preset = small(features=("height", "source"), points=512, width=0.25)
    detector = Detector(preset.build().eval(), preset, torch.device("cpu"))
    with pytest.raises(ValueError, match="feature 'source'"):
        detector.detect(box_frame(0)[0])


def raw(boxes: list[list[float]], logits: list[float], classes: list[int]) -> RawDetections:
    return RawDetections(torch.tensor(boxes), torch.tensor(logits), torch.tensor(classes))


def test_threshold_suppression_and_order() -> None:
    near, other = [CAR[0] + 0.3, *CAR[1:]], [*CAR[:2], 30.0, *CAR[3:]]
    flat = [*CAR[:2], 40.0, -0.1, *CAR[4:]]
    found = raw([CAR, near, CAR, other, other, flat], [1.0, 2.0, 0.5, -3.0, 0.1, 5.0], [0, 0, 1, 0, 0, 0])
    names = ("Car", "Cyclist")
    kept = final_detections([found], OutputSettings(0.3, 0.1), names)
    assert kept.classes == ("Car", "Cyclist", "Car")
    assert kept.scores.tolist() == pytest.approx([2.0, 0.5, 0.1])
    assert kept.boxes.values[0, 0] == pytest.approx(2.3)
    everyone = final_detections([found], OutputSettings(0.3, 0.1, nms_per_class=False), names)
    assert everyone.classes == ("Car", "Car")
    chances = final_detections([found], OutputSettings(0.3, 0.1, probability=True), names)
    assert chances.scores[0] == pytest.approx(1 / (1 + np.exp(-2)))
    assert len(final_detections([found], OutputSettings(0.999, 0.1), names)) == 0


def test_voting_by_hand() -> None:
    kept = torch.tensor([[0.0, 1.0, 10.0, 1.5, 2.0, 4.0, 0.1]], dtype=torch.float64)
    turned = torch.tensor([[0.0, 1.0, 10.0, 1.5, 2.0, 4.0, 0.1 + torch.pi]], dtype=torch.float64)
    higher = turned + torch.tensor([0, 0.3, 0, 0, 0, 0, 0.0], dtype=torch.float64)
    far = kept + torch.tensor([0, 0, 5.0, 0, 0, 0, 0], dtype=torch.float64)
    mean = vote(kept, torch.cat([kept, higher, far]), torch.tensor([0.5, 0.25, 0.9], dtype=torch.float64), 0.5)
    # BEV overlap 1 with both: weights 2 : 1; a half turn is no difference.
    assert mean[0].tolist() == pytest.approx([0, 1.1, 10, 1.5, 2, 4, 0.1])


def test_mirrored_pass_returns_to_the_scene(detector) -> None:
    # A cloud and its mirror image: the mirrored pass over one finds the mirror of the straight pass over the other.
    from detection.infer import _mirror_back

    boxes = torch.tensor([[2.0, 1.7, 20.0, 1.5, 1.6, 4.0, 0.3]])
    back = _mirror_back(RawDetections(boxes, torch.zeros(1), torch.zeros(1, dtype=torch.long))).boxes[0]
    assert back.tolist() == pytest.approx([-2.0, 1.7, 20.0, 1.5, 1.6, 4.0, np.pi - 0.3])


def test_imported_lidar_frame_detector_returns_camera_boxes(tmp_path) -> None:
    torch.manual_seed(0)
    torch.save({"model_state": OpenPCDetPointRCNN().state_dict()}, tmp_path / "a.pth")
    detector = imported_detector(tmp_path / "a.pth", "openpcdet_pointrcnn")
    detector = replace(detector, preset=replace(detector.preset, outputs=OutputSettings(0.0, 0.1)))
    frame = box_frame(0, cars=2)[0]
    found = detector.detect(frame)
    assert len(found) > 0
    # Untrained boxes stay near the points that proposed them: ahead of the camera and about the ground.
    assert (found.boxes.values[:, 2] > 0).all()
    assert np.abs(found.boxes.values[:, 1] - 1.7).max() < 3
    assert set(found.classes) <= {"Car", "Pedestrian", "Cyclist"}
    with pytest.raises(ValueError, match="unknown architecture"):
        imported_detector(tmp_path / "a.pth", "nothing")


def test_an_imported_openpcdet_network_is_saved_and_loaded_as_ours(tmp_path) -> None:
    torch.manual_seed(0)
    model = OpenPCDetPointRCNN().eval()
    preset = IMPORTED_PRESETS["openpcdet_pointrcnn"](model)
    path = save_checkpoint(model, preset, tmp_path / "ours.safetensors", {})
    loaded, again, _ = load_checkpoint(path)
    assert again.inputs == preset.inputs
    assert again.outputs == preset.outputs
    for name, tensor in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor), name
