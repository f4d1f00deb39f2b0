"""What holds for the three trainers alike: names of settings, seeds, validation, and what becomes of errors."""

from __future__ import annotations

import csv
import dataclasses
import json
import random
import typing
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import completion.train
import detection.train
from auglidar_base.errors import CheckpointError
from auglidar_base.progress import TrainProgress
from completion.models import default_spec
from completion.samples import Augmentation
from completion.train import TrainSettings as DepthSettings
from completion.training_loss import LossSettings
from detection.train import TrainSettings as DetectorSettings
from pipeline.base.settings import with_changes
from pipeline.cli import main
from pipeline.semantics.network import StreetSegmenter
from pipeline.semantics.training import SegmentationSettings, train_segmenter
from pipeline.semantics.validation import validation_figures
from pipeline.training.stage import print_progress, split
from tests.completion.scenes import Streets, street
from tests.detection.scenes import BoxFrames
from tests.pipeline.semantics.test_models import picture
from tests.pipeline.tiny_kitti import write_tiny_kitti

WORDS = {
    "batch_size": int,
    "learning_rate": float,
    "save_every": int,
    "validate_every": int,
    "device": str,
    "seed": int,
    "warm_start": str | None,
}
SPEC = default_spec("twise", channels=2)
Train = Callable[..., Path]


def train_depth(out: Path, **changes: typing.Any) -> Path:
    told = changes.pop("progress", None)
    settings = DepthSettings(SPEC, augmentation=Augmentation((32, 48)), accumulate=1, **{**SHORT, **changes})
    return completion.train.train(settings, Streets(2, 32, 48), out, [street(7, 32, 48)], progress=told)


def train_detector(out: Path, **changes: typing.Any) -> Path:
    told = changes.pop("progress", None)
    own = {"options": {"points": 512, "width": 0.25}, "batch_size": 1}
    settings = DetectorSettings(**{**SHORT, **own, **changes})
    return detection.train.train(settings, BoxFrames(2, cars=2), out, BoxFrames(1, cars=3), told)


def train_segmentation(out: Path, **changes: typing.Any) -> Path:
    told = changes.pop("progress", None)
    settings = SegmentationSettings(**{**SHORT, "crop": (32, 64), **changes})
    samples = [picture(np.random.default_rng(seed)) for seed in range(2)]
    return train_segmenter(settings, samples, out, samples[:1], told)


SHORT = {"steps": 2, "batch_size": 2, "seed": 3, "validate_every": 1, "save_every": 1, "log_every": 1}
TRAINERS: list[Train] = [train_depth, train_detector, train_segmentation]


@pytest.mark.parametrize("settings", [DepthSettings(SPEC), DetectorSettings(), SegmentationSettings()])
def test_the_same_words_in_all_three(settings: typing.Any) -> None:
    hints = typing.get_type_hints(type(settings))
    assert {name: hints[name] for name in WORDS} == WORDS
    names = {field.name for field in dataclasses.fields(settings)}
    assert hints["steps"] in (int, int | None)
    assert set(settings.RENAMED.values()) <= names
    assert not set(settings.RENAMED) & names
    described = [line.split("  ")[0] for line in str(type(settings).__doc__).splitlines() for line in [line.strip()]]
    assert {"steps", *WORDS} <= set(described)


@pytest.mark.parametrize("train", TRAINERS)
def test_equal_seeds_give_equal_weights_and_the_callers_generators_stay(tmp_path: Path, train: Train) -> None:
    weights = []
    for start in (0, 1):
        random.seed(start)
        np.random.seed(start)  # noqa: NPY002 (the caller's, which must stay as it is)
        torch.manual_seed(start)
        before = random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()  # noqa: NPY002
        weights.append(train(tmp_path / str(start)))
        assert random.getstate() == before[0]
        assert np.random.get_state()[1].tolist() == before[1]  # noqa: NPY002
        assert torch.get_rng_state().tolist() == before[2]
    assert weights[0].read_bytes() == weights[1].read_bytes()


@pytest.mark.parametrize("train", TRAINERS)
def test_files_and_progress_of_a_run(tmp_path: Path, train: Train) -> None:
    told: list[TrainProgress] = []
    assert train(tmp_path, progress=told.append) == tmp_path / "best.safetensors"
    assert [(each.step, each.steps, each.eta > 0) for each in told] == [(1, 2, True), (2, 2, False)]
    assert 0 < told[0].seconds < told[1].seconds
    for name in ("log.csv", "validation.csv"):
        with open(tmp_path / name, newline="") as file:
            assert [row["step"] for row in csv.DictReader(file)] == ["1", "2"]
    cards = [json.loads((tmp_path / f"{name}.json").read_text()) for name in ("best", "last")]
    assert all(len(card["sha256"]) == 64 for card in cards)
    # Everything is there already: the same files again, nothing trained.
    before = (tmp_path / "last.safetensors").read_bytes(), (tmp_path / "log.csv").read_bytes()
    train(tmp_path, progress=told.append)
    assert len(told) == 2
    assert before == ((tmp_path / "last.safetensors").read_bytes(), (tmp_path / "log.csv").read_bytes())


@pytest.mark.parametrize("train", TRAINERS)
def test_a_training_begins_with_other_weights(tmp_path: Path, train: Train) -> None:
    first = train(tmp_path / "first", steps=1)
    second = train(tmp_path / "second", steps=1, learning_rate=1e-12, warm_start=str(first))
    begun, went_on = load_file(first), load_file(second)
    parameters = [name for name in begun if name.endswith("weight")]
    for name in parameters:
        torch.testing.assert_close(went_on[name], begun[name], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("train", TRAINERS)
def test_a_state_of_an_earlier_version_is_told_in_a_line(tmp_path: Path, train: Train) -> None:
    header = {"run": json.dumps({"format": "auglidar-completion-run-1"}), "done": "3", "settings": "{}"}
    save_file({"model.x": torch.zeros(1)}, str(tmp_path / "state.safetensors"), header)
    with pytest.raises(CheckpointError, match=r"begun with AugLiDAR 0\.1\.0 before .* finish it there") as caught:
        train(tmp_path)
    assert "\n" not in str(caught.value)


def test_thesis_schedules_by_epochs_or_steps() -> None:
    thesis = DepthSettings(SPEC)
    assert (thesis.epochs, thesis.steps, thesis.halve_every) == (30, None, 5)
    changed = with_changes(thesis, {"steps": 7, "epochs": 2.5}, "train")
    assert (changed.steps, changed.epochs) == (7, 2.5)


def test_segmentation_figures_by_hand() -> None:
    """Four pixels at half size: truth road road sky none, all found road."""

    class AllRoad(StreetSegmenter):
        def forward(self, image: torch.Tensor) -> torch.Tensor:
            logits = torch.zeros(1, 19, 1, 1)
            logits[:, 0] = 1
            return logits

    sample = picture(np.random.default_rng(0), (96, 128))
    truth = np.zeros((4, 4), np.uint8)
    truth[2:, :2], truth[2:, 2:] = 10, 255
    one = dataclasses.replace(sample, image=sample.image[:4, :4], semantics=truth)
    figures = validation_figures(AllRoad(), [one], torch.device("cpu"))
    assert figures["pixel_accuracy"] == pytest.approx(2 / 3)
    assert figures["mean_iou"] == pytest.approx((2 / 3 + 0) / 2)


def test_progress_is_printed_in_one_way(capsys: pytest.CaptureFixture[str]) -> None:
    print_progress(TrainProgress(50, 200, {"loss": 1.2345, "sigma": 0.5}, 61.0, 183.0))
    print_progress(TrainProgress(200, 200, {"loss": 1.0}, 244.0, 0.0))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "step 50 of 200  loss 1.23  sigma 0.5  about 3 min 03 s left"
    assert lines[1] == "step 200 of 200  loss 1"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_kitti(tmp_path_factory.mktemp("kitti"), 1)


def command(data: Path, out: Path, *changes: str) -> list[str]:
    options = ["--config", "kitti", "--data", str(data), "--out", str(out), "--workers", "1", "--stage", "train"]
    return [*options, *(part for change in changes for part in ("--set", f"train.{change}"))]


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (["steps=0"], "train: steps: expected a value > 0, got 0"),
        (["device=gpu"], "train: device: expected auto, cpu, cuda, cuda:N or mps, got 'gpu'"),
        (["augmentation.crop=[9999, 32]"], "train: crop 9999x32 is larger than the frame"),
        (["warm_start=nowhere"], "train: nowhere: no such weights"),
        (
            ["network=detection", "preset=small", "options={wdith: 2}"],
            "train: options of preset small: got an unexpected",
        ),
        (["network=detection", "warm_start=nowhere"], "train: nowhere: expected a .safetensors file"),
        (["network=segmentation", "learning_rate=0"], "train: learning_rate: expected a value > 0"),
    ],
)
def test_a_bad_setting_is_one_line(data: Path, tmp_path: Path, capsys, changes: list[str], line: str) -> None:
    assert main([*command(data, tmp_path, *changes), "--set", "augment.preset=L"]) == 2
    error = capsys.readouterr().err.splitlines()
    assert error[-1].startswith(f"run_pipeline: {line}")
    assert not [text for text in error if "Traceback" in text]


def test_a_fault_deep_in_a_trainer_keeps_its_traceback(data: Path, tmp_path: Path, monkeypatch) -> None:
    def broken(*given: object) -> object:
        return np.zeros(2) + np.zeros(3)

    monkeypatch.setattr("completion.train.training_loss", broken)
    with pytest.raises(ValueError, match="could not be broadcast") as caught:
        main(command(data, tmp_path, "steps=1", "accumulate=1", "model.arguments.channels=2"))
    assert caught.traceback[-1].name == "broken"


def test_earlier_names_are_one_line_each_on_the_command_line(data: Path, tmp_path: Path, capsys) -> None:
    changes = ["batch=1", "checkpoint_steps=5", "objective.deepest=90", "read_out=hard", "row_steps=[1]", "steps=0"]
    assert main(command(data, tmp_path, *changes)) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "now; the earlier name" in line]
    new = ["batch_size", "save_every", "loss", "decoding", "beam_strides", "loss.max_depth"]
    assert sorted(line.split(" is called ")[1].split(" ")[0] for line in lines) == sorted(
        f"train.{name}" for name in new
    )
    assert all(line.startswith("run_pipeline: train.") for line in lines)


def test_frames_are_held_back_for_validation_only_when_asked_for() -> None:
    class Frames:
        def __init__(self, ids: list[str]) -> None:
            self.ids = ids

        def __len__(self) -> int:
            return len(self.ids)

        def select(self, ids: list[str]) -> Frames:
            return Frames(list(ids))

    frames: typing.Any = Frames([str(number) for number in range(40)])
    for every, most, held in ((0, 8, 0), (5, 8, 4), (5, 3, 3)):
        kept, validated = split(frames, SegmentationSettings(validate_every=every, validation_frames=most))
        assert (len(kept), len(validated)) == (40 - held, held)
        assert kept.ids + validated.ids == frames.ids
    assert LossSettings.RENAMED == {"deepest": "max_depth"}
