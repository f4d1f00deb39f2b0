from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from detection.checkpoints import load_tensors
from detection.frustum.checkpoints import load_frustum_checkpoint, save_frustum_checkpoint
from detection.frustum.network import FrustumPointNet
from detection.frustum.train import (
    FrustumTrainer,
    FrustumTrainSettings,
    gathered,
    learning_rate,
    norm_momentum,
    train_frustums,
)
from detection.kitti_format import KittiObject
from detection.types import PointFrame
from tests.detection.scenes import box_frame

TINY = FrustumTrainSettings(
    steps=4, batch_size=2, learning_rate=0.003, save_every=2, channels=3, classes=("Car",), points=24, copies=2
)


class OneCarEach:
    """Two frames with a car, whose labels are a little larger than what was scanned: no point lies on a face."""

    def __len__(self) -> int:
        return 2

    def __getitem__(self, index: int) -> tuple[PointFrame, list[KittiObject]]:
        frame, labels = box_frame(index, 1, 1500)
        points = np.concatenate([frame.points[:5000:8], frame.points[5000:]])
        (item,) = labels
        height, width, length = (1.06 * value for value in item.size)
        x, y, z = item.location
        return replace(frame, points=points), [replace(item, size=(height, width, length), location=(x, y - 0.02, z))]


def rows(path: Path) -> list[dict[str, float]]:
    with path.open() as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def test_two_frames_are_learned_by_heart(tmp_path: Path) -> None:
    settings = replace(TINY, steps=80, batch_size=4, points=64, copies=1, depth_shift="none", decay_samples=200)
    weights = train_frustums(replace(settings, save_every=80), OneCarEach(), tmp_path, validation=OneCarEach())
    losses = [row["loss"] for row in rows(tmp_path / "log.csv")]
    assert losses[-1] < losses[0] / 2
    (figures,) = rows(tmp_path / "validation.csv")
    assert figures["segmentation"] > 0.95
    assert figures["iou_3d"] > 0.4
    assert load_frustum_checkpoint(weights).channels == 3


def test_a_killed_run_continues_to_the_bit(tmp_path: Path) -> None:
    whole = train_frustums(TINY, OneCarEach(), tmp_path / "whole")
    trainer = FrustumTrainer(TINY, gathered(OneCarEach(), TINY))
    for step in range(2):
        trainer.step(step)
    (tmp_path / "killed").mkdir()
    trainer.save(tmp_path / "killed", 2)
    trainer.step(2)  # lost with the process
    continued = train_frustums(TINY, OneCarEach(), tmp_path / "killed")
    mine, theirs = load_tensors(whole)[0], load_tensors(continued)[0]
    assert all(torch.equal(mine[name], theirs[name]) for name in mine)
    state = [load_tensors(tmp_path / name / "state.safetensors")[0] for name in ("whole", "killed")]
    assert all(torch.equal(state[0][name], state[1][name]) for name in state[0])
    with pytest.raises(ValueError, match="the state of a run with other settings"):
        train_frustums(replace(TINY, seed=1), OneCarEach(), tmp_path / "killed")


def test_schedules_halve_with_the_frustums_seen() -> None:
    settings = FrustumTrainSettings()
    at = [0, 24_999, 25_000, 50_000, 250_000]  # 32 frustums a step
    assert [learning_rate(step, settings) for step in at] == [0.001, 0.001, 0.0005, 0.00025, 0.001 / 1024]
    assert [norm_momentum(step, settings) for step in at] == [0.5, 0.5, 0.25, 0.125, 0.01]


def test_a_warm_start_begins_with_its_weights(tmp_path: Path) -> None:
    torch.manual_seed(5)
    path = save_frustum_checkpoint(FrustumPointNet("tf", 3), tmp_path / "start.safetensors", {})
    trainer = FrustumTrainer(replace(TINY, warm_start=str(path)), gathered(OneCarEach(), TINY))
    start = load_tensors(path)[0]
    assert all(torch.equal(value, start[name]) for name, value in trainer.model.state_dict().items())
    with pytest.raises(ValueError, match="is variant tf with 3 channels, the settings ask for port with 3"):
        FrustumTrainer(replace(TINY, warm_start=str(path), variant="port"), gathered(OneCarEach(), TINY))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 0}, "steps: expected a value > 0"),
        ({"batch_size": 1}, "at least 2"),
        ({"variant": "keras"}, "variant: expected one of tf, port"),
        ({"depth_shift": "up"}, "depth_shift: expected one of intended"),
        ({"classes": ("Tram",)}, "classes: expected some of Car"),
        ({"device": "tpu"}, "device"),
    ],
)
def test_wrong_settings_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(TINY, **changes)  # type: ignore[arg-type]


def test_frames_without_objects_and_foreign_states_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no frustum of Cyclist"):
        train_frustums(replace(TINY, classes=("Cyclist",)), OneCarEach(), tmp_path)
    save_frustum_checkpoint(FrustumPointNet("tf", 3), tmp_path / "state.safetensors", {})
    with pytest.raises(ValueError, match=r"state.safetensors: expected the state of a Frustum PointNet training"):
        train_frustums(TINY, OneCarEach(), tmp_path)
