"""Bundled weights: figures by hand, what embedding writes, a second training beside the first, and clean cards."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from detection.kitti_format import KittiObject
from pipeline.base.errors import UsageError
from pipeline.data import open_dataset
from pipeline.pretrained import again, cards
from pipeline.pretrained.__main__ import main as embed
from pipeline.pretrained.cards import ROOMS, without_places
from pipeline.pretrained.figures import HeldOut, at_threshold, operating_point, segmentation_figures
from pipeline.run_folder.config import load_config
from pipeline.run_folder.weights import bundled_folder
from pipeline.semantics.conventions import NONE
from pipeline.semantics.inference import NetworkSegmenter
from pipeline.simulation.synth import SynthSettings
from pipeline.simulation.writers import write_dataset

NAMES = {"completion": "selection_small", "detection": "small_lidar", "segmentation": "street-small"}
# What `embed` is told of a training besides its run and the frames.
MADE = [
    "--config",
    "configs/weights/completion-large.yaml",
    "configs/weights/completion-small.yaml",
    "--limits",
    "dark",
]


@pytest.fixture(scope="module")
def streets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("streets")
    write_dataset(root, SynthSettings(frames=2, seed=3))
    return root


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty package to embed into."""
    monkeypatch.setattr(cards, "bundled_folder", lambda room: tmp_path / "package" / room / "weights")
    return tmp_path / "package"


def a_run(folder: Path, room: str) -> Path:
    """A finished training run: the shipped weights and their card."""
    source = bundled_folder(ROOMS[room]) / f"{NAMES[room]}.safetensors"
    target = folder / "weights" / room / "last.safetensors"
    target.parent.mkdir(parents=True)
    shutil.copyfile(source, target)
    card = json.loads(source.with_suffix(".json").read_text())
    card.pop("held_out", None)
    card.pop("trained_again", None)
    card |= {"seed": 5, "hours": 0.25}
    target.with_suffix(".json").write_text(json.dumps(card))
    return folder


def test_places_become_names() -> None:
    card = {"data": {"root": "/somewhere/data/train", "name": "kitti_object"}, "rows": ["/a/b.safetensors", 4]}
    expected = {"data": {"root": "train", "name": "kitti_object"}, "rows": ["b.safetensors", 4]}
    assert without_places(card) == expected


SHIPPED = [(room, path) for room in sorted(ROOMS) for path in sorted(bundled_folder(ROOMS[room]).glob("*.safetensors"))]


@pytest.mark.parametrize(("room", "weights"), SHIPPED, ids=[path.stem for _, path in SHIPPED])
def test_embedded_cards_are_complete(room: str, weights: Path) -> None:
    """Data, seed, command, hours, figures, limits; and nothing of the machine it was made on."""
    card = json.loads(weights.with_suffix(".json").read_text())
    assert without_places(card) == card
    assert card["name"] == weights.stem
    assert card["seed"] >= 0
    assert card["hours"] > 0
    assert len(card["limits"]) > 20
    assert all("synthetic world, seed" in text for text in card["data"])
    assert card["held_out"]["frames"] >= 50
    for other in card.get("trained_again", []):
        assert {key: other["held_out"][key] for key in ("frames", "labels")} == {
            key: card["held_out"][key] for key in ("frames", "labels")
        }
    networks = [
        load_config(re.search(r"--config (\S+) --stage train", text)[1]).train.network for text in card["command"]
    ]
    assert set(networks) == {room}


def test_embedded_weights_stay_small() -> None:
    assert {room for room, _ in SHIPPED} == set(ROOMS)
    assert sum(path.stat().st_size for _, path in SHIPPED) < 40e6


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_a_run_is_embedded_and_measured_again(room: str, tmp_path: Path, package: Path, streets: Path) -> None:
    run = a_run(tmp_path / "run", room)
    assert embed([room, str(run), "mine", "--data", str(streets), *MADE]) == 0
    weights = package / ROOMS[room] / "weights" / "mine.safetensors"
    shipped = bundled_folder(ROOMS[room]) / f"{NAMES[room]}.safetensors"
    assert weights.read_bytes() == shipped.read_bytes()
    card = json.loads(weights.with_suffix(".json").read_text())
    assert (card["name"], card["held_out"]["frames"], card["seed"], card["hours"]) == ("mine", 2, 5, 0.25)
    assert card["limits"] == "dark"
    assert card["data"] == ["800 frames of the synthetic world, seed 1001"]
    assert card["command"] == [f"run_pipeline --config {path} --stage train" for path in MADE[1:3]]
    if room == "detection":
        assert card["score_thresholds"] == {
            name: card["held_out"][at_threshold(name)]["threshold"] for name in ("Car", "Pedestrian", "Cyclist")
        }
        assert {"ap_r40", "ap_r40, 16 rows", "car, BEV IoU 0.7, hard, 16 rows"} < set(card["held_out"])
    for _ in range(2):
        again.main([room, str(run), "mine", "--data", str(streets)])
    noted = json.loads(weights.with_suffix(".json").read_text())
    (other,) = noted.pop("trained_again")
    assert (other["held_out"], other["seed"], other["hours"]) == (card["held_out"], 5, 0.25)
    assert noted == card


@pytest.mark.parametrize("frames", ["0:1", "1:2"])
def test_another_set_of_frames_measures_both(frames: str, tmp_path: Path, package: Path, streets: Path) -> None:
    run = a_run(tmp_path / "run", "segmentation")
    embed(["segmentation", str(run), "mine", "--data", str(streets), "--frames", "0:1", *MADE])
    card = package / ROOMS["segmentation"] / "weights" / "mine.json"
    first = json.loads(card.read_text())["held_out"]
    again.main(["segmentation", str(run), "mine", "--data", str(streets), "--frames", frames])
    noted = json.loads(card.read_text())
    assert [noted["held_out"]] == [each["held_out"] for each in noted["trained_again"]]
    assert (noted["held_out"] == first) == (frames == "0:1")


def test_frames_are_told_apart_by_their_labels(streets: Path) -> None:
    dataset = open_dataset("kitti_object", streets)
    kinds = [HeldOut(dataset.select(frames)).which for frames in ("0:1", "1:2", "0:2", "0:1")]
    assert [kind["frames"] for kind in kinds] == [1, 1, 2, 1]
    assert kinds[0] == kinds[3]
    assert len({kind["labels"] for kind in kinds}) == 3


def test_what_is_missing_is_said(tmp_path: Path, package: Path, streets: Path) -> None:
    with pytest.raises(UsageError, match="best, model or last"):
        embed(["completion", str(tmp_path), "mine", "--data", str(streets), *MADE])
    with pytest.raises(UsageError, match="embed a first training"):
        again.main(["completion", str(tmp_path), "mine", "--data", str(streets)])


def test_segmentation_figures_by_hand(streets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A segmenter that calls everything a car: right where there are cars, vehicles over all counted pixels."""
    monkeypatch.setattr(NetworkSegmenter, "segment", lambda self, image: np.full(image.shape[:2], 13, np.uint8))
    dataset = open_dataset("kitti_object", streets)
    classes = np.concatenate([frame.semantics.ravel() for frame in dataset])
    counted = classes[classes != NONE]
    figures = segmentation_figures(bundled_folder(ROOMS["segmentation"]) / "street-small.safetensors", dataset)
    assert figures["pixel_accuracy"] == pytest.approx(np.mean(counted == 13), abs=1e-4)
    assert figures["vehicle_iou"] == pytest.approx(np.isin(counted, [13, 14, 15]).mean(), abs=1e-4)
    assert 0 < figures["pixel_accuracy"] < 0.5


def car(z: float, score: float) -> KittiObject:
    return KittiObject("Car", 0, 0, 0, (0, 0, 50, 50), (1.5, 1.6, 4), (0, 1.5, z), 0, score)


def test_the_operating_point_is_the_lowest_with_enough_right_cars() -> None:
    """Cars at 10, 20, 30, 40 m found with scores .9 to .6; wrong ones at .65 and .3: from .6 four of five are right."""
    labels = [[car(z, 0) for z in (10, 20, 30, 40)]]
    found = [[*(car(z, 1 - z / 100) for z in (10, 20, 30, 40)), car(15, 0.65), car(25, 0.3)]]
    assert operating_point(labels, found) == {"threshold": 0.325, "recall": 1.0, "precision": 0.8}
    # Nothing of another class was reported: precision is undefined everywhere, and the first score as good as any.
    assert operating_point(labels, found, "Cyclist")["threshold"] == 0.1
