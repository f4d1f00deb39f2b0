"""What the numbers and colours of a label map mean. Always said, never guessed.

13 is a car as a Cityscapes trainId and a fence as a labelId: a map alone does not tell. Sources: Cityscapes scripts
(labels), KITTI semantics devkit (Cityscapes labelIds), Virtual KITTI 2 documentation (colors.txt).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError
from pipeline.data.vkitti2 import colors_to_train_ids

NONE = 255
CLASSES = (
    "road",
    "sidewalk",
    "building",
    "wall",
    "fence",
    "pole",
    "traffic light",
    "traffic sign",
    "vegetation",
    "terrain",
    "sky",
    "person",
    "rider",
    "car",
    "truck",
    "bus",
    "train",
    "motorcycle",
    "bicycle",
)
# What masks are compared and thresholded by: everything on four wheels or rails; people and what they ride.
GROUPS = {"vehicles": (13, 14, 15, 16), "people": (11, 12, 17, 18)}
# Cityscapes labelIds in the order of trainIds.
LABEL_IDS = (7, 8, 11, 12, 13, 17, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 31, 32, 33)
VKITTI2_COLORS = {
    "Terrain": (210, 0, 200),
    "Sky": (90, 200, 255),
    "Tree": (0, 199, 0),
    "Vegetation": (90, 240, 0),
    "Building": (140, 140, 140),
    "Road": (100, 60, 100),
    "GuardRail": (250, 100, 255),
    "TrafficSign": (255, 255, 0),
    "TrafficLight": (200, 200, 0),
    "Pole": (255, 130, 0),
    "Misc": (80, 80, 80),
    "Truck": (160, 60, 60),
    "Car": (255, 127, 80),
    "Van": (0, 139, 139),
    "Undefined": (0, 0, 0),
}

Where = str | Path


def _from_train_ids(stored: NDArray[Any], where: Where) -> NDArray[np.uint8]:
    labels = _one_channel(stored, where)
    wrong = (labels >= len(CLASSES)) & (labels != NONE)
    if wrong.any():
        found = ", ".join(str(value) for value in np.unique(labels[wrong])[:5])
        raise DataError(where, "Cityscapes trainIds (0-18, 255)", f"value {found}", "are these labelIds?")
    return labels


def _from_label_ids(stored: NDArray[Any], where: Where) -> NDArray[np.uint8]:
    labels = _one_channel(stored, where)
    # labelIds run from 0 to 33; licence plates are -1, which 8 bits store as 255.
    wrong = (labels > 33) & (labels != 255)
    if wrong.any():
        found = ", ".join(str(value) for value in np.unique(labels[wrong])[:5])
        raise DataError(where, "Cityscapes labelIds (0-33)", f"value {found}", "is this another convention?")
    table = np.full(256, NONE, np.uint8)
    table[list(LABEL_IDS)] = np.arange(len(LABEL_IDS))
    return table[labels]


def _from_vkitti2_colors(stored: NDArray[Any], where: Where) -> NDArray[np.uint8]:
    if stored.ndim != 3 or stored.shape[2] != 3 or stored.dtype != np.uint8:
        raise DataError(where, "an (H, W, 3) uint8 colour image", f"shape {stored.shape} {stored.dtype}")
    return colors_to_train_ids(stored, VKITTI2_COLORS, where)


def _one_channel(stored: NDArray[Any], where: Where) -> NDArray[np.uint8]:
    if stored.ndim != 2 or stored.dtype != np.uint8:
        raise DataError(where, "an (H, W) uint8 label map", f"shape {stored.shape} {stored.dtype}")
    return stored


# Convention -> function from the stored image (RGB where it has colours) to trainIds.
CONVENTIONS: dict[str, Callable[[NDArray[Any], Where], NDArray[np.uint8]]] = {
    "cityscapes_trainIds": _from_train_ids,
    "cityscapes_labelIds": _from_label_ids,
    "kitti": _from_label_ids,
    "vkitti2": _from_vkitti2_colors,
}


def to_train_ids(stored: NDArray[Any], convention: str | None, where: Where) -> NDArray[np.uint8]:
    """A stored label map -> (H, W) uint8 Cityscapes trainIds, 255 = none.

    Raises DataError without a convention, for an unknown one, and for values that it does not have.
    """
    if convention not in CONVENTIONS:
        raise DataError(
            where,
            f"a mask convention: {', '.join(CONVENTIONS)}",
            "none" if convention is None else repr(convention),
            "give --mask-convention or put mask.json with {'convention': ...} beside the masks; it is never guessed",
        )
    return CONVENTIONS[convention](stored, where)
