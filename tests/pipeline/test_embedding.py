"""Cards of embedded weights name no folder of the machine they were made on."""

import json
from pathlib import Path

import pytest

from pipeline.embedding import without_places
from pipeline.weights import embedded_folder


def test_places_become_names() -> None:
    card = {"data": {"root": "/somewhere/data/train", "name": "kitti_object"}, "rows": ["/a/b.safetensors", 4]}
    expected = {"data": {"root": "train", "name": "kitti_object"}, "rows": ["b.safetensors", 4]}
    assert without_places(card) == expected


@pytest.mark.parametrize("room", ["completion", "detection"])
def test_embedded_cards(room: str) -> None:
    cards = [json.loads(path.read_text()) for path in Path(embedded_folder(room)).glob("*.json")]
    assert cards
    for card in cards:
        assert without_places(card) == card
