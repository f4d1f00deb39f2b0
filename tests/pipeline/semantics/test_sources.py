"""Masks from files (convention stated, never guessed), truth and boxes."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from detection.kitti_format import KittiObject
from pipeline.base.errors import DataError, MissingPart, UsageError
from pipeline.data.frame import Frame
from pipeline.semantics.conventions import CONVENTIONS, to_train_ids
from pipeline.semantics.sources import boxes_to_semantics, open_semantics


def car(left: float, right: float, distance: float, kind: str = "Car") -> KittiObject:
    return KittiObject(kind, 0, 0, 0, (left, 1, right, 3), (1.5, 1.6, 4), (0, 1.6, distance), 0)


def frame(size: tuple[int, int] = (4, 6), **parts: object) -> Frame:
    loaders = {"image_size": lambda: size} | {name: (lambda value=value: value) for name, value in parts.items()}
    return Frame("000003", loaders, "test set")


def test_label_ids_become_train_ids() -> None:
    # Cityscapes: road 7, person 24, car 26, truck 27, caravan 29 (not evaluated), bicycle 33, unlabelled 0.
    stored = np.array([[7, 24, 26, 27, 29, 33, 0, 255]], np.uint8)
    for convention in ("cityscapes_labelIds", "kitti"):
        assert to_train_ids(stored, convention, "x").tolist() == [[0, 11, 13, 14, 255, 18, 255, 255]]


def test_thirteen_means_what_the_convention_says() -> None:
    stored = np.full((2, 2), 13, np.uint8)
    assert (to_train_ids(stored, "cityscapes_trainIds", "x") == 13).all()
    assert (to_train_ids(stored, "cityscapes_labelIds", "x") == 4).all()


def test_virtual_kitti_colours() -> None:
    stored = np.array([[[255, 127, 80], [0, 139, 139], [160, 60, 60], [100, 60, 100]]], np.uint8)
    assert to_train_ids(stored, "vkitti2", "x").tolist() == [[13, 13, 14, 0]]
    with pytest.raises(DataError, match="red and blue swapped"):
        to_train_ids(stored[..., ::-1], "vkitti2", "x")


@pytest.mark.parametrize("convention", [None, "coco"])
def test_no_convention_is_refused_not_guessed(convention: str | None) -> None:
    with pytest.raises(DataError, match="never guessed"):
        to_train_ids(np.zeros((2, 2), np.uint8), convention, "mask.png")


@pytest.mark.parametrize(
    ("convention", "value"), [("cityscapes_trainIds", 26), ("cityscapes_labelIds", 40), ("kitti", 200)]
)
def test_values_of_another_convention_are_refused(convention: str, value: int) -> None:
    with pytest.raises(DataError, match=str(value)):
        to_train_ids(np.full((2, 2), value, np.uint8), convention, "mask.png")
    with pytest.raises(DataError, match="uint8"):
        to_train_ids(np.zeros((2, 2), np.uint16), convention, "mask.png")


def test_every_convention_is_tested_here() -> None:
    assert set(CONVENTIONS) == {"cityscapes_trainIds", "cityscapes_labelIds", "kitti", "vkitti2"}


def test_folder_of_masks(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "000003.png"), np.full((4, 6), 26, np.uint8))
    source = open_semantics(f"files:{tmp_path}", "kitti")
    assert (source.semantics(frame()) == 13).all()
    with pytest.raises(DataError, match="never guessed"):
        open_semantics(f"files:{tmp_path}").semantics(frame())
    (tmp_path / "mask.json").write_text(json.dumps({"convention": "cityscapes_labelIds"}))
    assert (open_semantics(f"files:{tmp_path}").semantics(frame()) == 13).all()
    with pytest.raises(DataError, match="cropped"):
        source.semantics(frame((5, 6)))
    (tmp_path / "mask.json").write_text("[]")
    with pytest.raises(DataError, match="convention"):
        open_semantics(f"files:{tmp_path}")


def test_colour_masks_in_files_are_read_as_rgb(tmp_path: Path) -> None:
    colours = np.zeros((4, 6, 3), np.uint8)
    colours[:] = (255, 127, 80)
    cv2.imwrite(str(tmp_path / "000003.png"), colours[..., ::-1])
    assert (open_semantics(f"files:{tmp_path}", "vkitti2").semantics(frame()) == 13).all()


def test_boxes_nearest_on_top_and_inclusive() -> None:
    labels = [car(0, 3, 10), car(2, 5, 20, "Pedestrian"), car(4, 5, 5, "DontCare")]
    semantics = boxes_to_semantics(labels, (4, 6))
    assert semantics[1].tolist() == [13, 13, 13, 13, 11, 11]
    assert (semantics[0] == 255).all()
    assert (open_semantics("boxes").semantics(frame(labels=labels)) == semantics).all()
    outside = boxes_to_semantics([car(-9, -4, 5)], (4, 6))
    assert (outside == 255).all()


def test_truth_is_the_stored_map() -> None:
    stored = np.full((4, 6), 13, np.uint8)
    assert open_semantics("truth").semantics(frame(semantics=stored)) is stored
    with pytest.raises(MissingPart):
        open_semantics("truth").semantics(frame())


@pytest.mark.parametrize("source", ["", "guess", "files:", "onnx:", "hf"])
def test_unknown_sources_are_refused(source: str) -> None:
    with pytest.raises(UsageError, match="expected truth"):
        open_semantics(source)
