"""Completed depth from files: an earlier run of ours, or any published method as a folder of uint16 PNGs."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from completion.types import CompletedDepth
from pipeline.base.errors import DataError
from pipeline.data.depth_png import read_depth_png
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


def read_completed(folder: str | Path, frame_id: str, image_size: tuple[int, int] | None = None) -> CompletedDepth:
    """The completed depth of one frame from a run folder or a folder of PNGs.

    A run has depth/ID.png and, from a network with two surfaces, twin/ID.npz (foreground and background uint16 x 256,
    sigma uint8 / 255). Otherwise as `read_depth_folder`.

    Raises DataError when a file is missing or damaged.
    """
    run = Path(folder)
    if not (run / "depth").is_dir():
        return read_depth_folder(run, frame_id, image_size)
    twin = run / "twin" / f"{frame_id}.npz"
    if not twin.is_file():
        return read_depth_folder(run / "depth", frame_id, image_size)
    depth = read_depth_png(run / "depth" / f"{frame_id}.png")
    try:
        with np.load(twin, allow_pickle=False) as parts:
            foreground, background = (parts[name].astype(np.float32) / 256 for name in ("foreground", "background"))
            sigma = parts["sigma"].astype(np.float32) / 255
        return CompletedDepth(depth, foreground, background, sigma)
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise DataError(twin, "foreground, background and sigma maps of this frame", str(error)) from None


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
