"""A folder of photographs as textures for synthetic surfaces: square tiles in sizes from 512 pixels down."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import UsageError

ENDINGS = (".jpg", ".jpeg", ".png", ".tga", ".webp")
# Tiles are squares of this many pixels, and halved down to 8.
SIZE, LEVELS = 512, 7
# Pictures smaller than this, longer than this many times their width, or of fewer colours are no photographs of a
# surface: icons, strips, maps, masks.
_SMALLEST, _LONGEST, _COLOURS = 256, 2.5, 25

Tiles = NDArray[np.uint8]


@lru_cache(maxsize=2)
def read_photographs(folder: Path, most: int = 400) -> tuple[Tiles, ...]:
    """At most `most` usable pictures below a folder, as RGB tiles (N, 512, 512, 3), (N, 256, 256, 3), ... (N, 8, 8, 3).

    Of more, every n-th by name is taken. Raises UsageError where the folder holds none.
    """
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in ENDINGS)
    if not paths:
        raise UsageError(f"train.photographs: expected a folder of photographs ({', '.join(ENDINGS)}), got {folder}")
    tiles: list[Tiles] = []
    # In an order that takes from all subfolders alike, the same on every machine.
    for index in np.random.default_rng(0).permutation(len(paths)):
        tile = _tile(paths[int(index)])
        if tile is not None:
            tiles.append(tile)
        if len(tiles) == most:
            break
    if not tiles:
        raise UsageError(f"{folder}: none of {len(paths)} pictures is a photograph of at least {_SMALLEST} pixels")
    return _reduced(np.stack(tiles))


def _tile(path: Path) -> Tiles | None:
    """The middle square of a picture, (512, 512, 3) RGB; None for what is no photograph of a surface."""
    try:
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    if picture is None or min(picture.shape[:2]) < _SMALLEST:
        return None
    height, width = picture.shape[:2]
    side = min(height, width)
    if max(height, width) > _LONGEST * side:
        return None
    top, left = (height - side) // 2, (width - side) // 2
    square = picture[top : top + side, left : left + side, ::-1]
    tile = cv2.resize(np.ascontiguousarray(square), (SIZE, SIZE), interpolation=cv2.INTER_AREA).astype(np.uint8)
    colours = np.unique(tile[::8, ::8].reshape(-1, 3) // 16, axis=0)
    return tile if len(colours) >= _COLOURS else None


def _reduced(tiles: Tiles) -> tuple[Tiles, ...]:
    """The tiles and their halves, quarters, ...: what a texture looks like from farther away."""
    levels = [tiles]
    for _ in range(LEVELS - 1):
        n, side = levels[-1].shape[:2]
        blocks = levels[-1].reshape(n, side // 2, 2, side // 2, 2, 3)
        levels.append(blocks.mean(axis=(2, 4)).round().astype(np.uint8))
    return tuple(levels)
