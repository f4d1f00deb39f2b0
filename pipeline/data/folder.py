"""A user's own data: images, clouds and one calibration file (docs/data.md, "Your own data").

ROOT/calib.txt            KITTI object keys P2, R0_rect, Tr_velo_to_cam; calib/ID.txt wins for frames that have one
ROOT/images/ID.png|jpg    colour images, any size
ROOT/points/ID.bin        float32 x y z intensity; also .npy, .ply, .pcd
ROOT/labels/ID.txt        KITTI label lines                           (optional, as all below)
ROOT/sparse_depth/ID.png  ROOT/target_depth/ID.png                    16-bit, metres x 256
ROOT/semantics/ID.png     8-bit Cityscapes trainIds                   ROOT/instances/ID.png
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.base.errors import UsageError
from pipeline.data.cloud_files import SUFFIXES, read_points
from pipeline.data.dataset import Dataset
from pipeline.data.depth_png import read_depth_png
from pipeline.data.frame import Frame
from pipeline.data.images import image_size, read_image
from pipeline.data.kitti_object import read_instances, read_labels, read_semantics
from pipeline.geometry.calibration import read_calibration

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


def open_folder(root: str | Path) -> Dataset:
    """Frames of a user's folder, one per file in images/, sorted by name.

    Raises UsageError when there is no images/ folder or no image in it.
    """
    folder = Path(root)
    images = folder / "images"
    ids = sorted(path.stem for path in images.iterdir() if path.suffix in IMAGE_SUFFIXES) if images.is_dir() else []
    if not ids:
        raise UsageError(f"{folder}: no image found (expected images/ID.png or .jpg, points/ID.bin and calib.txt)")
    return Dataset(tuple(ids), partial(open_frame, folder), "folder", str(folder))


def _first(folder: Path, frame_id: str, suffixes: tuple[str, ...]) -> Path | None:
    """The file of a frame with one of the suffixes, or None."""
    paths = (folder / f"{frame_id}{suffix}" for suffix in suffixes)
    return next((path for path in paths if path.is_file()), None)


def open_frame(root: Path, frame_id: str) -> Frame:
    """One frame; nothing is read yet. Parts without a file are not offered."""
    image = _first(root / "images", frame_id, IMAGE_SUFFIXES) or root / "images" / f"{frame_id}.png"
    own = root / "calib" / f"{frame_id}.txt"
    loaders: dict[str, Callable[[], Any]] = {
        "image": partial(read_image, image),
        "image_size": partial(image_size, image),
        "calibration": partial(read_calibration, own if own.is_file() else root / "calib.txt"),
    }
    optional: dict[str, tuple[Callable[[Path], Any], Path | None]] = {
        "points": (read_points, _first(root / "points", frame_id, SUFFIXES)),
        "labels": (read_labels, _first(root / "labels", frame_id, (".txt",))),
        "sparse_depth": (read_depth_png, _first(root / "sparse_depth", frame_id, (".png",))),
        "target_depth": (read_depth_png, _first(root / "target_depth", frame_id, (".png",))),
        "semantics": (read_semantics, _first(root / "semantics", frame_id, (".png",))),
        "instances": (read_instances, _first(root / "instances", frame_id, (".png",))),
    }
    loaders.update({part: partial(reader, path) for part, (reader, path) in optional.items() if path is not None})
    return Frame(frame_id, loaders, str(root))
