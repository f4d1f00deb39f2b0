"""Score thresholds: one per class from the card, the single one of older cards, none without a card."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from detection.kitti_format import KittiObject
from pipeline.run_folder.config import load_config
from pipeline.run_folder.thresholds import ScoreThresholds
from pipeline.run_folder.weights import bundled_folder, bundled_names


def found(name: str, score: float | None) -> KittiObject:
    return KittiObject(name, 0, 0, 0, (0, 0, 50, 50), (1.7, 0.6, 0.8), (0, 1.5, 10), 0, score)


def test_every_class_has_its_own_start() -> None:
    least = ScoreThresholds.of_card({"score_thresholds": {"Car": 0.65, "Pedestrian": 0.4}})
    assert not least.shows(found("Car", 0.64))
    assert least.shows(found("Car", 0.65))
    assert least.shows(found("Pedestrian", 0.4))
    assert least.shows(found("Van", 0.01))
    assert least.shows(found("Car", None))  # a label
    assert least.text(["Car", "Van", "Pedestrian"]) == "Car 0.65, Pedestrian 0.4"


def test_cards_of_earlier_versions_have_one_for_all() -> None:
    least = ScoreThresholds.of_card({"score_threshold": 0.65})
    assert (least.of("Car"), least.of("Cyclist")) == (0.65, 0.65)
    assert ScoreThresholds.of_card({}).of("Car") == -math.inf


def test_a_run_takes_its_detectors_card(tmp_path: Path) -> None:
    (tmp_path / "mine.safetensors").write_bytes(b"")
    (tmp_path / "mine.json").write_text(json.dumps({"score_thresholds": {"Cyclist": 0.3}}))
    chosen = f"detection.model={tmp_path / 'mine.safetensors'}"
    assert ScoreThresholds.of_run(load_config("kitti", [chosen])).by_class == {"Cyclist": 0.3}
    assert ScoreThresholds.of_run(load_config("kitti", ["detection.model=nothing"])) == ScoreThresholds()


@pytest.mark.parametrize("name", bundled_names("detection"))
def test_bundled_cards_say_it_for_every_class(name: str) -> None:
    least = ScoreThresholds.of_file(bundled_folder("detection") / f"{name}.json")
    assert all(0 < least.of(kind) < 1 for kind in ("Car", "Pedestrian", "Cyclist"))
    assert set(least.by_class) == {"Car", "Pedestrian", "Cyclist"}
