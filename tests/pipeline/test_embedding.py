"""Embedded weights: figures by hand, what embedding writes, a second training beside the first, and clean cards."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from detection.kitti_format import KittiObject
from pipeline import embedding
from pipeline.data import open_dataset
from pipeline.embedding import AT_THRESHOLD, ROOMS, main, operating_point, segmentation_figures, without_places
from pipeline.errors import UsageError
from pipeline.semantics.conventions import NONE
from pipeline.semantics.network import NetworkSegmenter
from pipeline.simulation.synth import SynthSettings, write_dataset
from pipeline.weights import embedded_folder

NAMES = {"completion": "selection_small", "detection": "small_lidar", "segmentation": "street-small"}


@pytest.fixture(scope="module")
def streets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("streets")
    write_dataset(root, SynthSettings(frames=2, seed=3))
    return root


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty package to embed into."""
    monkeypatch.setattr(embedding, "embedded_folder", lambda room: tmp_path / "package" / room / "weights")
    return tmp_path / "package"


def a_run(folder: Path, room: str) -> Path:
    """A finished training run: the shipped weights and their card."""
    source = embedded_folder(ROOMS[room]) / f"{NAMES[room]}.safetensors"
    target = folder / "weights" / room / "model.safetensors"
    target.parent.mkdir(parents=True)
    shutil.copyfile(source, target)
    card = json.loads(source.with_suffix(".json").read_text())
    card.pop("held_out", None)
    card.pop("trained_again", None)
    target.with_suffix(".json").write_text(json.dumps(card))
    return folder


def test_places_become_names() -> None:
    card = {"data": {"root": "/somewhere/data/train", "name": "kitti_object"}, "rows": ["/a/b.safetensors", 4]}
    expected = {"data": {"root": "train", "name": "kitti_object"}, "rows": ["b.safetensors", 4]}
    assert without_places(card) == expected


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_embedded_cards(room: str) -> None:
    cards = [json.loads(path.read_text()) for path in Path(embedded_folder(ROOMS[room])).glob("*.json")]
    assert cards
    for card in cards:
        assert without_places(card) == card


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_a_run_is_embedded_and_measured_again(room: str, tmp_path: Path, package: Path, streets: Path) -> None:
    run = a_run(tmp_path / "run", room)
    assert main([room, str(run), "mine", "--data", str(streets)]) == 0
    weights = package / ROOMS[room] / "weights" / "mine.safetensors"
    shipped = embedded_folder(ROOMS[room]) / f"{NAMES[room]}.safetensors"
    assert weights.read_bytes() == shipped.read_bytes()
    card = json.loads(weights.with_suffix(".json").read_text())
    assert (card["name"], card["held_out"]["frames"]) == ("mine", 2)
    if room == "detection":
        assert card["score_threshold"] == card["held_out"][AT_THRESHOLD]["threshold"]
        assert {"ap_r40", "ap_r40, 16 rows", f"{AT_THRESHOLD}, 16 rows"} < set(card["held_out"])
    for _ in range(2):
        main([room, str(run), "mine", "--data", str(streets), "--again"])
    again = json.loads(weights.with_suffix(".json").read_text())
    assert [each["held_out"] for each in again.pop("trained_again")] == [card["held_out"]]
    assert again == card


def test_another_set_of_frames_measures_both(tmp_path: Path, package: Path, streets: Path) -> None:
    run = a_run(tmp_path / "run", "segmentation")
    main(["segmentation", str(run), "mine", "--data", str(streets)])
    main(["segmentation", str(run), "mine", "--data", str(streets), "--frames", "0:1", "--again"])
    card = json.loads((package / ROOMS["segmentation"] / "weights" / "mine.json").read_text())
    assert [card["held_out"]["frames"], *(each["held_out"]["frames"] for each in card["trained_again"])] == [1, 1]
    assert card["held_out"] == card["trained_again"][0]["held_out"]


def test_what_is_missing_is_said(tmp_path: Path, package: Path, streets: Path) -> None:
    with pytest.raises(UsageError, match="best, model or last"):
        main(["completion", str(tmp_path), "mine", "--data", str(streets)])
    with pytest.raises(UsageError, match="embed a first training"):
        main(["completion", str(tmp_path), "mine", "--data", str(streets), "--again"])


def test_segmentation_figures_by_hand(streets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A segmenter that calls everything a car: right where there are cars, vehicles over all counted pixels."""
    monkeypatch.setattr(NetworkSegmenter, "segment", lambda self, image: np.full(image.shape[:2], 13, np.uint8))
    dataset = open_dataset("kitti_object", streets)
    classes = np.concatenate([frame.semantics.ravel() for frame in dataset])
    counted = classes[classes != NONE]
    figures = segmentation_figures(embedded_folder(ROOMS["segmentation"]) / "street-small.safetensors", dataset)
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
