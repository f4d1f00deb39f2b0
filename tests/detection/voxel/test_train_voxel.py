"""Training voxel detectors by the same loop as the point detectors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from detection.checkpoints import load_tensors
from detection.data_augmentation import PasteSettings
from detection.infer import Detector, load_detector
from detection.kitti_format import KittiObject, boxes_of
from detection.models.batch import PointBatch
from detection.models.pointpillars import PointPillars
from detection.models.pv_rcnn import PVRCNN
from detection.models.second import SECOND
from detection.models.warm_start import copy_matching
from detection.ops import iou_3d
from detection.optimiser import OneCycleSettings
from detection.train import Trainer, TrainSettings, train
from detection.types import PointFrame
from tests.detection.scenes import BoxFrames
from tests.detection.voxel import tiny

OPTIMISER = OneCycleSettings(decay=0.01, clip=10.0)


def settings(preset: str, **changes: object) -> TrainSettings:
    base = TrainSettings(preset=preset, options={"classes": ["Car"]}, steps=2, batch_size=1, seed=3, save_every=1)
    return replace(base, learning_rate=0.003, optimiser=OPTIMISER, **changes)  # type: ignore[arg-type]


class ColouredFrames(BoxFrames):
    """Box frames as augmented clouds: a fifth column says measured or completed."""

    def __getitem__(self, index: int) -> tuple[PointFrame, list[KittiObject]]:
        frame, labels = super().__getitem__(index)
        source = (np.arange(len(frame.points)) % 2).astype(np.float32)
        points = np.column_stack([frame.points, source])
        return PointFrame(points, frame.T_cam_velo, frame.P2, frame.image_size, frame.id), labels


def test_a_run_continues_to_the_bit_with_augmentation_and_pasting(tmp_path) -> None:
    run = settings("pointpillars_small", paste=PasteSettings())
    whole = train(run, BoxFrames(2, cars=2), tmp_path / "whole")
    trainer = Trainer(run, BoxFrames(2, cars=2))
    trainer.step(0)
    (tmp_path / "parts").mkdir()
    trainer.save(tmp_path / "parts", 1)
    parts = train(run, BoxFrames(2, cars=2), tmp_path / "parts")
    first, second = load_tensors(whole)[0], load_tensors(parts)[0]
    assert all(torch.equal(first[name], second[name]) for name in first)
    detector = load_detector(whole)
    assert detector.preset.name == "pointpillars_small"


def test_extra_columns_reach_the_network() -> None:
    run = settings("pointpillars_small", options={"features": ["intensity", "source"], "classes": ["Car"]})
    batch = Trainer(run, ColouredFrames(1, cars=2)).batch(0)
    assert batch.points.shape == (1, 0, 5)
    assert set(batch.clouds[0][:, 4].tolist()) == {0.0, 1.0}
    assert batch.clouds[0][:, 0].min() > 0  # x points forward
    assert batch.boxes[0].shape == (2, 7)
    assert batch.boxes[0][:, 3].min() > batch.boxes[0][:, 4].max()  # length before width


@pytest.mark.parametrize("build", [tiny.tiny_second, tiny.tiny_voxel_rcnn, tiny.tiny_pv_rcnn])
def test_every_parameter_is_trained_and_statistics_move(build) -> None:
    model = build().train()
    truth = torch.tensor([[1.5, 0.0, -1.0, 2.0, 1.5, 1.5, 0.3]])
    # Boxes like a proposal, so that the second stage has foreground.
    with torch.no_grad():
        rois = model.first_stage([tiny.cloud()])[1].boxes[0, :1]
    boxes = torch.cat([truth, rois])
    batch = PointBatch(
        torch.zeros(2, 0, 4),
        [tiny.cloud(), tiny.cloud(seed=2)],
        [boxes, truth[:0]],
        [torch.ones(2, dtype=torch.long), torch.zeros(0, dtype=torch.long)],
    )
    before = {name: value.clone() for name, value in model.named_buffers() if name.endswith("running_mean")}
    losses = model.training_losses(batch, np.random.default_rng(0))
    parts = [value for name, value in losses.items() if name != "loss"]
    torch.testing.assert_close(losses["loss"], torch.stack(parts).sum())
    losses["loss"].backward()
    without = [name for name, parameter in model.named_parameters() if parameter.grad is None]
    assert without == []
    finite = [bool(torch.isfinite(parameter.grad).all()) for parameter in model.parameters()]
    assert all(finite)
    moved = [not torch.equal(value, before[name]) for name, value in model.named_buffers() if name in before]
    assert all(moved)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "steps", "overlap"), [("pointpillars_small", 100, 0.7), ("voxel_rcnn_small", 130, 0.6)]
)
def test_two_frames_are_learnt_by_heart(preset, steps, overlap) -> None:
    frames = BoxFrames(2)
    trainer = Trainer(settings(preset, steps=steps, scene=None), frames)
    for step in range(steps):
        trainer.step(step)
    detector = Detector(trainer.model.eval(), trainer.preset, torch.device("cpu"))
    for frame, labels in frames.frames:
        found = detector.detect(frame)
        best = iou_3d(found.boxes.values, boxes_of(labels).values).max(axis=0)
        assert best.min() > overlap
        assert set(found.classes) == {"Car"}


@pytest.mark.parametrize("build", [tiny.tiny_pillars, tiny.tiny_pv_rcnn])
@torch.no_grad()
def test_a_warm_start_with_one_more_column_computes_the_same(build) -> None:
    old = build()
    if build is tiny.tiny_pillars:
        new: torch.nn.Module = PointPillars(replace(old.settings, point_channels=5)).eval()
    else:
        wider = replace(old.settings, point_channels=5)
        new = PVRCNN(wider, old.stages, old.pfe.settings, old.roi_head.settings).eval()
    widened = copy_matching(old, new)
    assert len(widened) == (1 if build is tiny.tiny_pillars else 3)
    points = tiny.cloud()
    more = torch.cat([points, torch.rand(len(points), 1)], dim=1)
    before, after = old([points]), new([more])
    first = (before, after) if build is tiny.tiny_pillars else (before.first, after.first)
    torch.testing.assert_close(first[1].bev, first[0].bev)
    if build is not tiny.tiny_pillars:
        torch.testing.assert_close(after.refined.reg, before.refined.reg)


def test_a_two_stage_network_starts_from_the_first_stage_alone() -> None:
    target = tiny.tiny_pv_rcnn()
    source = SECOND(target.settings)
    for weight in source.state_dict().values():
        weight.copy_(torch.rand(weight.shape))
    second_stage = target.roi_head.state_dict()
    before = {name: weight.clone() for name, weight in second_stage.items()}
    assert copy_matching(source, target) == []
    assert all(torch.equal(target.state_dict()[name], weight) for name, weight in source.state_dict().items())
    assert all(torch.equal(second_stage[name], weight) for name, weight in before.items())
    with pytest.raises(ValueError, match="networks differ in"):
        copy_matching(target, source)
