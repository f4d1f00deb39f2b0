"""Training: exact resume after SIGKILL, processes that agree, schedules, reproducible samples, signs of life."""

from __future__ import annotations

import csv
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from completion.checkpoints import load_checkpoint
from completion.diagnostics import diagnose, edge_mask, measured_region, sigma_statistics
from completion.infer import load_completer
from completion.losses import twin_loss
from completion.models import build_model, default_spec, with_rgb
from completion.models.classical import ClassicalCompleter
from completion.samples import Augmentation, StepBatches, disturb_image, draw_crop
from completion.train import TrainProgress, TrainSettings, learning_rate, scales_at, train
from completion.training_loss import LossSettings, pixel_weights, training_loss
from completion.types import CompletedDepth, DepthFrame
from tests.completion.scenes import Streets, street
from tests.completion.training_run import settings

ROOT = Path(__file__).resolve().parents[2]


def run(out: Path, architecture: str, kill_at: int = 0) -> int:
    command = [sys.executable, "-m", "tests.completion.training_run", str(out), architecture, str(kill_at)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, timeout=120, check=False).returncode


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ["selection", "twise"])
def test_killed_twice_and_resumed_gives_the_same_bits(tmp_path: Path, architecture: str) -> None:
    assert run(tmp_path / "whole", architecture) == 0
    assert run(tmp_path / "killed", architecture, kill_at=11) == -signal.SIGKILL
    assert run(tmp_path / "killed", architecture, kill_at=13) == -signal.SIGKILL
    assert run(tmp_path / "killed", architecture) == 0
    for name in ("last.safetensors", "best.safetensors", "log.csv", "validation.csv"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "killed" / name).read_bytes(), name


@pytest.mark.slow
def test_two_processes_take_the_steps_of_one(tmp_path: Path) -> None:
    """torchrun with two CPU processes of one sample each equals one process that accumulates two."""
    assert run(tmp_path / "one", "selection") == 0
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command = [*torchrun, "-m", "tests.completion.training_run", str(tmp_path / "two"), "selection", "0"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    one, two = load_file(tmp_path / "one/last.safetensors"), load_file(tmp_path / "two/last.safetensors")
    for name, value in one.items():
        # Sums in another order, amplified by Adam's division at small gradients.
        torch.testing.assert_close(two[name], value, rtol=1e-2, atol=2e-3)


@pytest.mark.parametrize("architecture", ["selection", "nlspn"])
def test_stopping_by_time_and_going_on(tmp_path: Path, architecture: str) -> None:
    whole = replace(settings(architecture), max_steps=5, validate_every=0)
    first = train(whole, Streets(11, 64, 96), tmp_path / "run", seconds=0.0)
    assert load_checkpoint(first)[1].training["step"] == 1
    last = train(whole, Streets(11, 64, 96), tmp_path / "run")
    assert load_checkpoint(last)[1].training["step"] == 5
    at_once = train(whole, Streets(11, 64, 96), tmp_path / "other")
    assert last.read_bytes() == at_once.read_bytes()


def test_progress_and_hours_of_a_continued_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that moves on by an hour whenever it is asked."""
    asked = iter(range(1000))
    monkeypatch.setattr("completion.train.time", SimpleNamespace(monotonic=lambda: 3600.0 * next(asked)))
    whole = replace(settings("selection"), max_steps=5, validate_every=0)
    told: list[TrainProgress] = []
    hours = []
    for seconds in (0.0, None):
        weights = train(whole, Streets(11, 64, 96), tmp_path, seconds=seconds, progress=told.append)
        hours.append(load_checkpoint(weights)[1].training["hours"])
    assert [(each.step, each.steps) for each in told] == [(1, 5), (2, 5), (4, 5), (5, 5)]
    assert told[0].eta == (5 - 1) * told[0].seconds
    assert told[1].seconds >= told[0].seconds + 3600
    assert told[-1].eta == 0
    assert hours[0] >= 2
    assert hours[1] >= hours[0] + 4  # at least the four steps of the second part


def test_a_run_goes_on_only_under_its_own_settings(tmp_path: Path) -> None:
    short = replace(settings("selection"), max_steps=2)
    train(short, Streets(3, 64, 96), tmp_path)
    with pytest.raises(ValueError, match="other settings"):
        train(replace(short, seed=1), Streets(3, 64, 96), tmp_path)
    train(replace(short, max_steps=3), Streets(3, 64, 96), tmp_path)  # longer is no other run


def table(path: Path) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_outputs_of_a_run(tmp_path: Path) -> None:
    short = replace(settings("twise"), max_steps=4, validate_every=2, decoding="hard")
    best = train(short, Streets(5, 64, 96), tmp_path, [street(7, 64, 96)], facts={"data": "streets"})
    card = load_checkpoint(best)[1]
    assert (card.decoding, card.training["data"]) == ("hard", "streets")
    assert card.training["settings"]["learning_rate"] == 1e-3
    rows = table(tmp_path / "log.csv")
    assert [row["step"] for row in rows] == ["2", "4"]
    assert {"loss", "foreground", "background", "fusion", "loss_1", "loss_2", "learning_rate"} <= set(rows[0])
    validations = table(tmp_path / "validation.csv")
    assert {"mae_mm", "grey_mae_mm", "sigma_spread", "sigma_correlation", "mixed_percent"} <= set(validations[0])
    found = load_completer(best).complete(street(8, 50, 80).sparse, street(8, 50, 80).image)
    assert found.size == (50, 80)


@pytest.mark.parametrize(
    ("architecture", "arguments", "loss_kind"),
    [
        ("msg_chn", {"channels": 4}, "l2"),
        ("msg_chn", {"channels": 4, "extra_skips": False}, "huber"),
        pytest.param("depth_coefficients", {"count": 12, "size": 5.0}, "dc", marks=pytest.mark.slow),
    ],
)
def test_several_kinds_of_networks_train(tmp_path: Path, architecture: str, arguments: dict, loss_kind: str) -> None:
    own = TrainSettings(
        default_spec(architecture, **arguments),
        LossSettings(loss_kind),
        Augmentation((32, 48)),
        epochs=1,
        steps_per_epoch=2,
        batch_size=2,
        accumulate=1,
    )
    path = train(own, Streets(4, 64, 96), tmp_path, [street(1, 48, 64)])
    assert load_checkpoint(path)[1].training["step"] == 2


@pytest.mark.parametrize(
    ("architecture", "loss_kind"),
    [
        ("twise_resnet", "twin"),
        ("sparse_to_dense", "l1_l2"),
        ("depth_coefficients", "dc"),
        ("resnet_dc_to_depth", "l2"),
        ("resnet_depth_to_depth", "l1"),
        ("resnet_depth_to_dc", "dc"),
        ("resnet_dc_to_dc", "dc"),
    ],
)
def test_every_loss_reaches_every_parameter(architecture: str, loss_kind: str) -> None:
    spec = default_spec(architecture)
    torch.manual_seed(0)
    model = build_model(spec)
    frame = street(2, 32, 48)
    assert frame.target is not None
    sparse, target = (torch.from_numpy(x)[None, None] for x in (frame.sparse, frame.target))
    outputs = model(sparse / spec.depth_unit, torch.rand(1, 3, 32, 48))
    outputs = outputs if isinstance(outputs, tuple) else (outputs,)
    parts = training_loss(outputs, sparse, target, spec, LossSettings(loss_kind), (1.0,), 0.0)
    parts["loss"].backward()
    assert all(p.grad is not None for p in model.parameters())
    if loss_kind == "dc" and len(outputs) == 2:
        expected = parts["entropy"] + 0.8 * parts["entropy_1"]
        assert float(parts["loss"].detach()) == pytest.approx(float(expected.detach()))


def test_scales_and_the_sigma_term_add_up() -> None:
    spec = default_spec("twise", channels=2)
    outputs = tuple(torch.rand(1, 3, 16 // s, 16 // s) for s in (1, 2, 4))
    target = torch.rand(1, 1, 16, 16) * 40 + 1
    parts = training_loss(outputs, 0 * target, target, spec, LossSettings(sigma_weight=(2.0, 0.0)), (1, 0.1, 0), 0.25)
    first = parts["foreground"] + parts["background"] + parts["fusion"] + 1.5 / 80 * parts["sigma"]
    assert "loss_2" not in parts
    assert float(parts["loss"]) == pytest.approx(float(first + 0.1 * parts["loss_1"]), rel=1e-6)


def test_a_step_of_l2_lowers_the_loss_like_adam_by_hand(tmp_path: Path) -> None:
    """One step of Adam moves every parameter with a gradient by the learning rate, against the gradient's sign."""
    own = replace(settings("twise"), max_steps=1, log_every=1)
    before = _initial(own)
    train(own, Streets(4, 64, 96), tmp_path)
    after = load_file(tmp_path / "last.safetensors")
    moved = torch.cat([(after[k] - before[k]).abs().flatten() for k in before])
    assert float(moved.max()) == pytest.approx(1e-3, rel=1e-3)
    assert float((moved > 0.9e-3).float().mean()) > 0.5


def _initial(own: TrainSettings) -> dict[str, torch.Tensor]:
    torch.manual_seed(own.seed)
    return {k: v.clone() for k, v in build_model(own.model).state_dict().items()}


def test_learning_rate_halves_every_five_epochs() -> None:
    published = TrainSettings(default_spec("twise"))
    rates = [learning_rate(published, epoch * 100, 100, 3000) for epoch in (0, 4.99, 5, 9.99, 10, 29)]
    assert rates == pytest.approx([1e-3, 1e-3, 5e-4, 5e-4, 2.5e-4, 1e-3 / 32])


def test_cosine_and_warmup() -> None:
    cosine = TrainSettings(default_spec("twise"), schedule="cosine", warmup_steps=9)
    assert learning_rate(cosine, 0, 100, 1000) == pytest.approx(1e-4)
    assert learning_rate(cosine, 500, 100, 1000) == pytest.approx(5e-4)
    assert learning_rate(cosine, 999, 100, 1000) < 1e-8


def test_scale_weights_of_the_thesis() -> None:
    published = TrainSettings(default_spec("twise"))
    assert [scales_at(published, e) for e in (0, 9.9, 10, 19.9, 20, 29)] == [
        (1, 1, 1),
        (1, 1, 1),
        (1, 0.1, 0.1),
        (1, 0.1, 0.1),
        (1, 0, 0),
        (1, 0, 0),
    ]


def test_settings_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="needs a network with output 'twin'"):
        TrainSettings(default_spec("msg_chn"))
    with pytest.raises(ValueError, match="for a GPU"):
        TrainSettings(default_spec("twise"), precision="bf16")
    with pytest.raises(ValueError, match="gamma"):
        LossSettings(gamma=0.5)
    with pytest.raises(ValueError, match="schedule"):
        TrainSettings(default_spec("twise"), schedule="linear")


def test_batches_depend_on_seed_and_step_alone() -> None:
    crops = Augmentation((32, 48), gamma=0.3, noise=5, drop=0.1, edge_crops=0.5)
    one = StepBatches(Streets(7, 64, 96), crops, seed=1, batch=2, accumulate=2, crops_per_frame=2)
    again = StepBatches(Streets(7, 64, 96), crops, seed=1, batch=2, accumulate=2, crops_per_frame=2)
    again[3]
    for a, b in zip(one[5], again[5]):
        for x, y in zip(a, b):  # frames without a camera have matrices of NaN
            torch.testing.assert_close(x, y, rtol=0, atol=0, equal_nan=True)
    other = StepBatches(Streets(7, 64, 96), crops, seed=2, batch=2, accumulate=2, crops_per_frame=2)
    assert not torch.equal(one[5][0].rgb, other[5][0].rgb)
    assert not torch.equal(one[5][0].rgb, one[6][0].rgb)


def test_processes_share_a_step() -> None:
    crops = Augmentation((32, 48))
    whole = StepBatches(Streets(7, 64, 96), crops, 0, batch=2, accumulate=2, crops_per_frame=1)[4]
    parts = [StepBatches(Streets(7, 64, 96), crops, 0, 2, 1, 1, rank, 2)[4] for rank in (0, 1)]
    assert torch.equal(torch.cat([b.sparse for b in whole]), torch.cat([p[0].sparse for p in parts]))


def test_an_epoch_visits_every_frame_once() -> None:
    class Counting(Streets):
        read: list[int]

        def __getitem__(self, index: int):  # type: ignore[no-untyped-def]
            self.read.append(index)
            return super().__getitem__(index)

    source = Counting(6, 64, 96)
    source.read = []
    batches = StepBatches(source, Augmentation((32, 32)), 0, batch=1, accumulate=2, crops_per_frame=1)
    for step in range(3):
        batches[step]
    assert sorted(source.read) == list(range(6))
    for step in range(3, 6):
        batches[step]
    assert sorted(source.read[6:]) == list(range(6))
    assert source.read[:6] != source.read[6:]


def test_crops_keep_image_sparse_and_target_together() -> None:
    """The image's red channel and both maps carry the column number: after crop and flip they still agree."""
    columns = np.tile(np.arange(1, 101, dtype=np.float32), (40, 1))
    image = np.repeat(columns[..., None].astype(np.uint8), 3, 2)
    frame = DepthFrame(image, columns, columns)
    crop = Augmentation((16, 24), flip=0.5, jitter=0)
    flipped = 0
    for seed in range(20):
        sparse, rgb, target = draw_crop(frame, crop, np.random.default_rng(seed))
        assert sparse.shape == (16, 24)
        assert np.array_equal(sparse, target)
        assert np.array_equal(rgb[..., 0], sparse.astype(np.uint8))
        flipped += int(sparse[0, 0] > sparse[0, 1])
    assert 0 < flipped < 20


def test_bottom_crops_and_refusals() -> None:
    frame = street(0, 64, 96)
    assert frame.target is not None
    bottom = Augmentation((16, 96), bottom=True, flip=0, jitter=0)
    _, _, target = draw_crop(frame, bottom, np.random.default_rng(0))
    assert np.array_equal(target, frame.target[48:])
    with pytest.raises(ValueError, match="larger than the frame"):
        draw_crop(frame, Augmentation((65, 96)), np.random.default_rng(0))
    with pytest.raises(ValueError, match="needs a target"):
        draw_crop(DepthFrame(frame.image, frame.sparse), bottom, np.random.default_rng(0))
    with pytest.raises(ValueError, match="must divide"):
        StepBatches(Streets(2), bottom, 0, batch=2, accumulate=1, crops_per_frame=3)


def test_dropped_samples_and_image_disturbance() -> None:
    frame = street(0, 64, 96)
    plain = Augmentation(flip=0, jitter=0)
    sparse, image, _ = draw_crop(frame, replace(plain, drop=0.5), np.random.default_rng(1))
    assert 0.4 < (sparse > 0).sum() / (frame.sparse > 0).sum() < 1
    assert set(np.unique(sparse)) <= set(np.unique(frame.sparse))
    assert np.array_equal(image, frame.image)
    grey = np.full((8, 8, 3), 100, np.uint8)
    noisy = disturb_image(grey, replace(plain, noise=10.0), np.random.default_rng(2))
    assert 0 < noisy.std() < 10
    darker = [disturb_image(grey, replace(plain, gamma=1.0), np.random.default_rng(s)).mean() for s in range(20)]
    assert min(darker) < 80 < 120 < max(darker)


def test_pixel_weights() -> None:
    target = torch.full((1, 1, 8, 8), 20.0)
    target[..., 4:] = 5.0
    target[0, 0, 0, 0] = 0
    sparse = torch.zeros_like(target)
    sparse[0, 0, 3] = 20.0
    weights = pixel_weights(sparse, target, LossSettings(edge_weight=4, relative_weight=1.0, above_top_ring=0.0))
    assert weights[0, 0, :3].max() == 0
    assert float(weights[0, 0, 5, 0]) == pytest.approx(0.5)
    assert float(weights[0, 0, 5, 7]) == pytest.approx(1.0)
    assert float(weights[0, 0, 5, 4]) == pytest.approx(5.0)
    assert torch.equal(pixel_weights(sparse, target, LossSettings()), (target > 0).float())
    assert pixel_weights(sparse, target, LossSettings(max_depth=10.0))[..., :4].max() == 0


def test_a_step_edge_teaches_two_surfaces() -> None:
    """Half of the truths of a pixel say 10, half 30: the surfaces go to either side, sigma follows colour."""
    generator = torch.Generator().manual_seed(0)
    parameters = torch.tensor([20.0, 20.0], requires_grad=True)
    slope = torch.zeros(1, requires_grad=True)
    optimiser = torch.optim.Adam([parameters, slope], lr=0.3)
    for _ in range(200):
        is_near = torch.rand(1, 1, 8, 8, generator=generator) < 0.5
        target = torch.where(is_near, 10.0, 30.0)
        colour = torch.where(is_near, 1.0, -1.0)
        near, far = (parameters[i].expand_as(target) for i in (0, 1))
        output = torch.cat((near, far, slope * colour), 1)
        optimiser.zero_grad()
        twin_loss(output, target, torch.ones_like(target), gamma=2.0).total.backward()
        optimiser.step()
    assert float(parameters[0].detach()) == pytest.approx(10, abs=1)
    assert float(parameters[1].detach()) == pytest.approx(30, abs=1)
    assert float(torch.sigmoid(slope.detach())) > 0.95


def test_diagnostics_tell_a_live_sigma_from_a_dead_one() -> None:
    target = np.full((20, 30), 10.0, np.float32)
    target[:, 15:] = 30.0
    near, far = np.full_like(target, 10.0), np.full_like(target, 30.0)
    alive = np.where(target == 10, 0.9, 0.1).astype(np.float32)
    found = sigma_statistics(CompletedDepth(target, near, far, alive), target)
    assert found["sigma_spread"] == pytest.approx(0.4)
    assert found["sigma_correlation"] == pytest.approx(1.0)
    assert found["sigma_correct"] == 1.0
    assert found["surfaces_apart"] == 1.0
    dead = sigma_statistics(CompletedDepth(target, near, far, np.full_like(target, 0.5)), target)
    assert (dead["sigma_spread"], dead["sigma_correlation"]) == (0.0, 0.0)
    assert np.flatnonzero(edge_mask(target)[5]).tolist() == [13, 14, 15, 16]


def test_diagnostics_compare_with_a_grey_image() -> None:
    frame = street(3, 64, 96)
    found = diagnose(ClassicalCompleter(), [frame])
    assert found["grey_mae_mm"] == found["other_mae_mm"] == found["mae_mm"] > 0  # this one does not look at colour

    class Looks:
        def complete(self, sparse, image, K=None):  # type: ignore[no-untyped-def]
            return CompletedDepth(np.full_like(sparse, 1.0 + image.std() + image[:, : image.shape[1] // 3].mean()))

    looked = diagnose(Looks(), [frame])
    scores = ("mae_mm", "tmae_mm", "edge_tmae_mm", "mixed_percent")
    assert {f"{picture}{score}" for picture in ("", "grey_", "other_") for score in scores} <= set(looked)
    assert len({looked["mae_mm"], looked["grey_mae_mm"], looked["other_mae_mm"]}) == 3
    with pytest.raises(ValueError, match="no frame with a target"):
        diagnose(Looks(), [DepthFrame(frame.image, frame.sparse)])


def test_diagnostics_leave_out_what_was_not_measured() -> None:
    target = np.full((10, 50), 20.0, np.float32)
    target[:, 40:] = 90.0
    sparse = np.zeros_like(target)
    sparse[4, 10] = 20.0
    image = np.zeros((10, 50, 3), np.uint8)
    region = measured_region(DepthFrame(image, sparse, target))
    assert (region > 0).sum() == 6 * 27  # rows 4-9, columns 0-26
    assert (measured_region(DepthFrame(image, 0 * sparse, target)) > 0).sum() == 10 * 40


def test_colour_scaling_is_part_of_the_model() -> None:
    assert with_rgb(default_spec("twise"), "standardised").rgb == "standardised"
