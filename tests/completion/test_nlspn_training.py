"""What NLSPN's training recipe needs beside the network: warped frames, clamped depths, a staircase of rates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from auglidar_base.errors import SettingsError
from completion.models import default_spec
from completion.samples import Augmentation, draw_crop
from completion.train import TrainSettings, learning_rate
from completion.training_loss import LossSettings, training_loss
from completion.types import DepthFrame
from completion.warping import enlarged, turned
from pipeline.base.settings import with_changes
from tests.completion.scenes import street

ROOT = Path(__file__).resolve().parents[2]


def views(height: int = 12, width: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    frame = street(3, height, width, 4)
    assert frame.target is not None
    return frame.sparse, frame.image, frame.target


def test_an_enlarged_frame_is_nearer_and_keeps_measured_values() -> None:
    sparse, image, target = enlarged(views(), 1.3)
    assert sparse.shape == target.shape == image.shape[:2] == (15, 26)  # int(12 x 1.3), int(20 x 1.3)
    before = views()
    assert np.isin(np.round(target * 1.3, 3), np.round(before[2], 3)).all()
    assert np.isin(np.round(sparse * 1.3, 3), np.round(before[0], 3)).all()
    with pytest.raises(ValueError, match="expected >= 1"):
        enlarged(before, 0.9)


def test_a_quarter_turn_is_rot90() -> None:
    sparse, image, target = views(11, 11)
    found = turned((sparse, image, target), 90.0)
    for before, after in zip((sparse, image, target), found):
        np.testing.assert_array_equal(after, np.rot90(before))


def test_rows_at_the_top_are_left_out_and_all_three_views_move_together() -> None:
    rows = np.tile(np.arange(1, 61, dtype=np.float32)[:, None], (1, 80))
    frame = DepthFrame(np.repeat(rows[..., None].astype(np.uint8) * 4, 3, 2), rows, rows)
    plain = Augmentation((20, 40), flip=0, jitter=0, top=25)
    for seed in range(5):
        sparse, image, target = draw_crop(frame, plain, np.random.default_rng(seed))
        assert target.min() >= 26
        np.testing.assert_array_equal(sparse, target)
    warped = replace(plain, rotate=5.0, scale=1.5)
    sparse, image, target = draw_crop(frame, warped, np.random.default_rng(1))
    np.testing.assert_array_equal(sparse, target)
    seen = target > 0
    factor = np.median(image[..., 0][seen] / 4 / target[seen])
    assert 1 < factor < 1.5
    assert np.abs(image[..., 0][seen] / 4 - factor * target[seen]).max() < 1.5
    with pytest.raises(SettingsError, match="scale: expected >= 1"):
        Augmentation(scale=0.5)


def test_depth_is_clamped_on_both_sides_of_the_loss() -> None:
    spec = default_spec("nlspn")
    target = torch.tensor([[[[95.0, 0.0, 10.0, 5.0]]]])
    output = torch.tensor([[[[92.0, 3.0, -4.0, 6.0]]]])
    settings = LossSettings("l1_l2", clamp_depth=90.0)
    parts = training_loss((output,), 0 * target, target, spec, settings, (1.0,), 0.0)
    # 95 and 92 are both 90; -4 is 0, off by 10; 6 is off by 1: three valid pixels
    assert float(parts["loss"]) == pytest.approx((0 + 10 + 1) / 3 + (0 + 100 + 1) / 3)
    with pytest.raises(SettingsError, match="clamp_depth is for networks with output 'depth'"):
        TrainSettings(default_spec("twise"), LossSettings(clamp_depth=90.0))


@pytest.mark.parametrize(("name", "deepest"), [("nlspn-kitti", 90), ("nlspn-nyu", 10)])
def test_the_recipes_are_the_authors(name: str, deepest: float) -> None:
    train = yaml.safe_load((ROOT / "configs" / "training" / f"{name}.yaml").read_text(encoding="utf-8"))["train"]
    assert train.pop("network") == "completion"
    settings = with_changes(TrainSettings(default_spec("nlspn"), LossSettings("l2")), train, "train")
    assert (settings.loss.kind, settings.loss.clamp_depth, settings.epochs) == ("l1_l2", deepest, 20)
    assert (settings.augmentation.rotate, settings.augmentation.scale) == (5, 1.5)
    assert settings.model.arguments == {"layers": 34, "preserve_input": True}
    short = replace(settings, warmup_steps=99)
    rates = [learning_rate(short, step, 100, 2000) for step in (0, 49, 99, 999, 1000, 1499, 1500, 1999)]
    assert rates == pytest.approx([1e-5, 5e-4, 1e-3, 1e-3, 2e-4, 2e-4, 4e-5, 4e-5])


def test_a_staircase_begins_at_epoch_0() -> None:
    with pytest.raises(SettingsError, match="rate_factors: expected pairs"):
        TrainSettings(default_spec("nlspn"), LossSettings("l2"), schedule="staircase", rate_factors=((5, 1.0),))


def test_later_settings_do_not_end_earlier_runs() -> None:
    """Fields added after a run began count once they are used."""
    plain = TrainSettings(default_spec("nlspn"), LossSettings("l2"))
    assert replace(plain, rate_factors=((0, 1.0),)).identity == plain.identity
    for changed in (
        replace(plain, rate_factors=((0, 1.0), (10, 0.2))),
        replace(plain, loss=LossSettings("l2", clamp_depth=90.0)),
        replace(plain, augmentation=Augmentation(rotate=5.0)),
    ):
        assert changed.identity != plain.identity
