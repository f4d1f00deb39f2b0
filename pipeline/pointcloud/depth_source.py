"""Completed depth from any published method: a folder of uint16 PNGs, one per frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from completion.types import CompletedDepth
from pipeline.data.depth_png import read_depth_png
from pipeline.errors import DataError
from pipeline.pointcloud.pseudo_sigma import pseudo_sigma


def read_depth_folder(folder: str | Path, frame_id: str, image_size: tuple[int, int] | None = None) -> CompletedDepth:
    """The completed depth FOLDER/ID.png of one frame, with two surfaces from `pseudo_sigma`.

    The file is KITTI's depth format: uint16, metres x 256, 0 = no value. A map smaller than `image_size` (many methods
    predict the lower 352 x 1216 pixels, cut from the middle and the bottom) is placed there; the rest has no value.

    Raises DataError when the file is missing, is not a uint16 PNG, or is larger than the image.
    """
    depth = read_depth_png(Path(folder) / f"{frame_id}.png")
    if image_size is not None and depth.shape != tuple(image_size):
        depth = placed_bottom_centre(depth, image_size, Path(folder) / f"{frame_id}.png")
    return pseudo_sigma(depth)


def placed_bottom_centre(
    depth: NDArray[np.float32], image_size: tuple[int, int], where: str | Path
) -> NDArray[np.float32]:
    """A crop from the bottom centre of an (H, W) image put back into it; 0 elsewhere."""
    (height, width), (h, w) = image_size, depth.shape
    if h > height or w > width:
        raise DataError(where, f"a depth map of at most {height} x {width}", f"{h} x {w}")
    full = np.zeros((height, width), np.float32)
    left = (width - w) // 2
    full[height - h :, left : left + w] = depth
    return full
