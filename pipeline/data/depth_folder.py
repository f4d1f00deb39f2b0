"""Completed depth of any published method, as a folder of uint16 PNGs (a run's own: `FrameOutputs.read_completed`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from completion.types import CompletedDepth
from pipeline.base.errors import DataError
from pipeline.data.depth_png import read_depth_png


def read_depth_folder(folder: str | Path, frame_id: str, image_size: tuple[int, int]) -> CompletedDepth:
    """The completed depth FOLDER/ID.png of one frame, with one surface.

    The file is KITTI's depth format: uint16, metres x 256, 0 = no value. A map smaller than `image_size` (many methods
    predict the lower 352 x 1216 pixels, cut from the middle and the bottom) is placed there; the rest has no value.

    Raises DataError when the file is missing, is not a uint16 PNG, has no value, or is larger than the image.
    """
    path = Path(folder) / f"{frame_id}.png"
    depth = read_depth_png(path)
    if not depth.any():
        raise DataError(path, "a depth map with values", "no pixel has a value")
    if depth.shape != tuple(image_size):
        depth = placed_bottom_centre(depth, image_size, path)
    return CompletedDepth(depth)


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
