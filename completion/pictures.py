"""Does a network look at the picture? The same sparse map with the true picture, a flat one, and another frame's.

A network that ignores the camera scores alike with all three. One that is better with the true picture than with a flat
one looks at it; one that is worse with another frame's than with a flat one trusts it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
# The true picture stands first: its scores are the network's.
PICTURES = ("true", "grey", "other")
GREY = 128


def pictures_of(image: Image, other: Image) -> dict[str, Image]:
    """The pictures (H, W, 3) by name of `PICTURES`; `other` is fitted to the frame's size."""
    return {"true": image, "grey": np.full_like(image, GREY), "other": fitted(other, image.shape[:2])}


def fitted(image: Image, size: Sequence[int]) -> Image:
    """The picture cut to (height, width) at the right and below, or continued there by its last column and row."""
    height, width = size
    cut = image[:height, :width]
    missing = ((0, height - cut.shape[0]), (0, width - cut.shape[1]), (0, 0))
    return np.ascontiguousarray(np.pad(cut, missing, mode="edge"))


def other_number(number: int, count: int) -> int:
    """The frame whose picture stands in for that of frame `number` of `count`: half way round, no neighbour of it."""
    return (number + count // 2) % count


def other_picture(number: int, images: Sequence[Image]) -> Image:
    """The picture of `other_number`; a single frame takes its own, mirrored."""
    return images[0][:, ::-1] if len(images) == 1 else images[other_number(number, len(images))]
