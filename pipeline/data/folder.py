"""A user's own data: images, clouds and one calibration file (docs/data.md, "Your own data").

ROOT/calib.txt            KITTI object keys P2, R0_rect, Tr_velo_to_cam; calib/ID.txt wins for frames that have one
ROOT/images/ID.png|jpg    colour images, any size
ROOT/points/ID.bin        float32 x y z intensity; also .npy, .ply, .pcd
ROOT/labels/ID.txt        KITTI label lines                           (optional, as all below)
ROOT/sparse_depth/ID.png  ROOT/target_depth/ID.png                    16-bit, metres x 256
ROOT/semantics/ID.png     8-bit Cityscapes trainIds                   ROOT/instances/ID.png
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.base.errors import UsageError
from pipeline.data.cloud_columns import CloudForm, cloud_form
from pipeline.data.cloud_files import SUFFIXES, read_points
from pipeline.data.dataset import Dataset
from pipeline.data.depth_png import read_depth_png
from pipeline.data.frame import Frame
from pipeline.data.images import image_size, read_image
from pipeline.data.kitti_object import read_instances, read_labels, read_semantics
from pipeline.data.part_files import PartFiles, as_dataset, index_frames
from pipeline.geometry.calibration import read_calibration

# part -> (folder, suffixes, the preferred one first)
_LAYOUT: dict[str, tuple[str, tuple[str, ...]]] = {
    "image": ("images", (".png", ".jpg", ".jpeg")),
    "points": ("points", SUFFIXES),
    "calibration": ("calib", (".txt",)),
    "labels": ("labels", (".txt",)),
    "sparse_depth": ("sparse_depth", (".png",)),
    "target_depth": ("target_depth", (".png",)),
    "semantics": ("semantics", (".png",)),
    "instances": ("instances", (".png",)),
}


def open_folder(root: str | Path, columns: int | None = None, keep_empty: bool = False) -> Dataset:
    """Frames of a user's folder, one per file in images/, sorted by name.

    columns     float32 numbers per point of .bin clouds; None: 4, unless the clouds show another number (refused)
    keep_empty  keep points of PLY and PCD files without a return (0 0 0), and refuse NaN; else they are left out
    Raises UsageError when there is no images/ folder or no image in it.
    """
    folder = Path(root)
    parts = {part: PartFiles(folder / name, suffixes) for part, (name, suffixes) in _LAYOUT.items()}
    index = index_frames(parts, ("image",))
    if not index.ids:
        raise UsageError(f"{folder}: no image found (expected images/ID.png or .jpg, points/ID.bin and calib.txt)")
    clouds = [folder / "points" / n for n in parts["points"].stems().values() if n.lower().endswith(".bin")]
    form = replace(cloud_form(clouds, columns), keep_empty=keep_empty)
    opener = partial(open_frame, folder, index.parts, form)
    return as_dataset(index, Dataset(index.ids, opener, "folder", str(folder), refusal=form.refusal_of(folder)))


def open_frame(root: Path, parts: Mapping[str, PartFiles], form: CloudForm, frame_id: str) -> Frame:
    """One frame; nothing is read yet. Parts without a file are not offered."""
    paths = {part: files.path(frame_id) for part, files in parts.items()}
    own = paths["calibration"]
    loaders: dict[str, Callable[[], Any]] = {
        "image": partial(read_image, paths["image"]),
        "image_size": partial(image_size, paths["image"]),
        "calibration": partial(read_calibration, own if own.is_file() else root / "calib.txt"),
    }
    optional: dict[str, Callable[[Path], Any]] = {
        "labels": read_labels,
        "sparse_depth": read_depth_png,
        "target_depth": read_depth_png,
        "semantics": read_semantics,
        "instances": read_instances,
    }
    if paths["points"].is_file():
        loaders["points"] = partial(read_points, paths["points"], form)
    loaders.update({part: partial(read, paths[part]) for part, read in optional.items() if paths[part].is_file()})
    return Frame(frame_id, loaders, str(root))
