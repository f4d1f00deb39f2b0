"""Completed depth of any published method, as a folder of uint16 PNGs (a run's own: `FrameOutputs.read_completed`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from completion.types import CompletedDepth
from pipeline.base.errors import DataError
from pipeline.data.depth_fit import require_fit
from pipeline.data.depth_png import read_depth_png


def read_depth_folder(
    folder: str | Path, frame_id: str, image_size: tuple[int, int], lidar: NDArray[np.float32] | None = None
) -> CompletedDepth:
    """The completed depth FOLDER/ID.png of one frame, with one surface.

    The file is KITTI's depth format: uint16, metres x 256, 0 = no value. A map smaller than `image_size` (many methods
    predict the lower 352 x 1216 pixels, cut from the middle and the bottom) is placed there; the rest has no value.

    lidar  (H, W) sparse metres of the frame, to compare the map with (`depth_fit.require_fit`); None: it is not

    Raises DataError when the file is missing, is not a uint16 PNG, has no value, is larger than the image, or does not
    fit the LiDAR.
    """
    path = Path(folder) / f"{frame_id}.png"
    depth = read_depth_png(path)
    if not depth.any():
        raise DataError(path, "a depth map with values", "no pixel has a value")
    placed = depth
    if depth.shape != tuple(image_size):
        placed = placed_bottom_centre(depth, image_size, path)
    if lidar is not None:
        require_fit(depth, lidar, path)
    return CompletedDepth(placed)


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
