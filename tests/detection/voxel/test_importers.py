"""OpenPCDet checkpoints of the voxel detectors: both spconv layouts, missing counters, other classes and columns."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from detection.checkpoints import load_checkpoint, save_checkpoint
from detection.importers import import_checkpoint, import_with_report
from detection.infer import Detector, imported_detector
from detection.models.presets import IMPORTED_PRESETS, PRESETS
from detection.types import PointFrame
from tests.detection.scenes import box_frame
from tests.detection.voxel.tiny import randomised

NAMES = {"pointpillar": "pointpillars", "second": "second", "voxel_rcnn": "voxel_rcnn", "pv_rcnn": "pv_rcnn"}


def write(path: Path, tensors: dict[str, Tensor]) -> Path:
    torch.save({"epoch": 80, "it": 1, "model_state": tensors, "optimizer_state": None, "version": "pcdet+0.6"}, path)
    return path


def public(model: nn.Module, layout: int) -> dict[str, Tensor]:
    """The state dict as spconv 1.x or 2.x writes it, without counters (old files lack them)."""
    found = {}
    for name, value in model.state_dict().items():
        if not name.endswith("num_batches_tracked"):
            found[name] = value.permute(1, 2, 3, 4, 0).contiguous() if value.dim() == 5 and layout == 1 else value
    return found


@pytest.mark.parametrize("layout", [1, 2])
@pytest.mark.parametrize("architecture", list(NAMES))
def test_every_tensor_is_consumed_whatever_the_layout(tmp_path, architecture, layout) -> None:
    model = randomised(PRESETS[NAMES[architecture]]().build())
    tensors = public(model, layout)
    found, report = import_with_report(write(tmp_path / "net.pth", tensors), architecture)
    assert sorted(report.consumed) == sorted(tensors)
    assert report.unused == ()
    assert all(torch.equal(value, model.state_dict()[name]) for name, value in found.state_dict().items())
    assert not found.training


@pytest.mark.parametrize("layout", [1, 2])
@pytest.mark.parametrize("architecture", ["pointpillar", "second"])
def test_classes_and_columns_are_read_from_the_shapes(tmp_path, architecture, layout) -> None:
    model = PRESETS[NAMES[architecture]](features=("intensity", "source"), classes=("Car",)).build()
    found = import_checkpoint(write(tmp_path / "net.pth", public(model, layout)), architecture)
    preset = IMPORTED_PRESETS[architecture](found)
    assert preset.classes == ("Car",)
    assert preset.inputs.features == ("intensity", "source")
    # An imported network is saved and loaded as one of our own.
    again, loaded, _ = load_checkpoint(save_checkpoint(found, preset, tmp_path / "own.safetensors", {}))
    assert loaded.name == NAMES[architecture]
    assert all(torch.equal(value, found.state_dict()[name]) for name, value in again.state_dict().items())


def test_what_does_not_fit_is_named(tmp_path) -> None:
    tensors = public(PRESETS["second"]().build(), 2)
    with pytest.raises(
        ValueError,
        match=r"missing vfe\.pfn_layers.*weight is \(128, 256, 3, 3\), expected \(64, 64",
    ):
        import_checkpoint(write(tmp_path / "net.pth", tensors), "pointpillar")
    tensors["backbone_3d.conv2.0.0.weight"] = torch.zeros(3, 3, 3, 16, 33)
    with pytest.raises(ValueError, match=r"conv2\.0\.0\.weight is"):
        import_checkpoint(write(tmp_path / "net.pth", tensors), "second")
    tensors = {"vfe.pfn_layers.0.linear.weight": torch.zeros(64, 30)}
    with pytest.raises(ValueError, match=r"net\.pth: expected 3 to 6 point channels.*has 24"):
        import_checkpoint(write(tmp_path / "net.pth", tensors), "pointpillar")


def test_an_imported_detector_has_the_published_thresholds(tmp_path) -> None:
    path = write(tmp_path / "net.pth", public(PRESETS["voxel_rcnn"]().build(), 1))
    outputs = imported_detector(path, "voxel_rcnn").preset.outputs
    assert (outputs.score_threshold, outputs.nms_iou, outputs.nms_per_class, outputs.limit) == (0.3, 0.1, False, 500)


def test_detections_are_the_same_every_time_and_at_most_the_limit() -> None:
    preset = PRESETS["voxel_rcnn_small"]()
    model = randomised(preset.build())
    frame, _ = box_frame(0)
    found = Detector(model, preset, torch.device("cpu")).detect(frame)
    again = Detector(model, preset, torch.device("cpu"), seed=9).detect(frame)
    assert len(found) > 3
    np.testing.assert_array_equal(found.boxes.values, again.boxes.values)
    assert (np.diff(found.scores) <= 0).all()
    assert (found.scores > 0.1).all()
    assert (found.scores < 1).all()
    fewer = replace(preset, outputs=replace(preset.outputs, limit=3))
    first = Detector(model, fewer, torch.device("cpu")).detect(frame)
    np.testing.assert_array_equal(first.boxes.values, found.boxes.values[:3])
    nothing = PointFrame(np.zeros((0, 4), np.float32), frame.T_cam_velo, frame.P2, frame.image_size)
    assert len(Detector(model, preset, torch.device("cpu")).detect(nothing)) == 0
