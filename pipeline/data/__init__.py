"""Data sets: `open_dataset(name, root)` gives frames whose parts are read when they are asked for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pipeline.base.errors import UsageError
from pipeline.data.dataset import Dataset
from pipeline.data.folder import open_folder
from pipeline.data.frame import Frame
from pipeline.data.kitti_depth import open_kitti_depth
from pipeline.data.kitti_object import open_kitti_object
from pipeline.data.kitti_raw import open_kitti_raw
from pipeline.data.nyuv2 import open_nyuv2
from pipeline.data.vkitti2 import open_vkitti2

__all__ = ["READERS", "Dataset", "Frame", "open_dataset"]

# name -> reader; a reader takes the root folder and gives a Dataset
READERS: dict[str, Callable[[Path], Dataset]] = {
    "kitti_object": open_kitti_object,
    "kitti_depth": open_kitti_depth,
    "kitti_raw": open_kitti_raw,
    "vkitti2": open_vkitti2,
    "nyuv2": open_nyuv2,
    "folder": open_folder,
}


def open_dataset(name: str, root: str | Path, columns: int | None = None, keep_empty: bool = False) -> Dataset:
    """The data set `name` (a key of READERS) in the folder `root`.

    columns     float32 numbers per point of .bin clouds, when they are not x y z intensity
    keep_empty  keep points without a return of PLY and PCD files (`folder` only)
    Raises UsageError for an unknown name, a missing folder or a folder without frames.
    """
    if name not in READERS:
        raise UsageError(f"unknown data set {name!r}; known: {', '.join(READERS)}")
    if name == "folder":
        return open_folder(root, columns, keep_empty)
    if name == "kitti_object":
        return open_kitti_object(root, columns)
    if columns is not None:
        raise UsageError(f"data.columns={columns}: {name} has clouds of one form; for kitti_object and folder only")
    return READERS[name](Path(root))
