"""KITTI object detection layout: reader and writer.

    ROOT/training/{image_2,velodyne,calib,label_2}/ID.{png|jpg,bin,txt,txt}      ROOT/ImageSets/{train,val,...}.txt

Also image_02/label_02, and Waymo's image_0/label_0 with P0 and Tr_velo_to_cam_0 in the calibration.

Beyond the official folders, synthetic data may hold `depth_2` (dense true depth, 16-bit PNG), `semantic_2` (uint8
Cityscapes trainIds) and `instance_2` (uint16, 0 = none); they are read when present. Source: KITTI object devkit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from auglidar_base.atomic import write_bytes, write_text
from detection.kitti_format import KittiObject, format_line, parse_lines
from pipeline.base.errors import DataError, UsageError
from pipeline.base.files import read_text
from pipeline.data.bin_clouds import read_velodyne
from pipeline.data.cloud_columns import CloudForm, cloud_form
from pipeline.data.dataset import Dataset
from pipeline.data.depth_png import png_bytes, read_depth_png, write_depth_png
from pipeline.data.frame import Frame
from pipeline.data.images import image_size, read_image, read_unchanged
from pipeline.data.part_files import PartFiles, as_dataset, first_folder, index_frames
from pipeline.geometry.calibration import Calibration, format_calibration, read_calibration

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
# part -> (folders it may lie in, suffixes). image_0 and label_0 are the front camera of Waymo's KITTI form; image_02
# and label_02 are folders of KITTI's tracking benchmark.
_LAYOUT: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "image": (("image_2", "image_02", "image_0"), IMAGE_SUFFIXES),
    "points": (("velodyne",), (".bin",)),
    "calibration": (("calib",), (".txt",)),
    "labels": (("label_2", "label_02", "label_0"), (".txt",)),
    "target_depth": (("depth_2",), (".png",)),
    "semantics": (("semantic_2",), (".png",)),
    "instances": (("instance_2",), (".png",)),
}
# Files that make a frame: one that lacks one of them is reported when it is used, one that lacks two is no frame.
_MAKERS = ("image", "points", "calibration")


def open_kitti_object(root: str | Path, columns: int | None = None) -> Dataset:
    """The frames of a KITTI object folder, sorted by id.

    root     the folder that holds training/ (or testing/), or such a folder itself
    columns  float32 numbers per point of the .bin clouds; None: 4, unless the clouds show another number (refused)
    Raises UsageError when there is no such folder or no frame in it.
    """
    folder = split_folder(Path(root))
    parts = {part: PartFiles(first_folder(folder, names), suffixes) for part, (names, suffixes) in _LAYOUT.items()}
    index = index_frames(parts, _MAKERS, fewest=2)
    if not index.ids:
        raise UsageError(f"{folder}: no frame found (expected files in image_2/, velodyne/ and calib/)")
    form = cloud_form([parts["points"].folder / name for name in parts["points"].stems().values()], columns)
    opener = partial(open_frame, str(folder), index.parts, form)
    return as_dataset(index, Dataset(index.ids, opener, "kitti_object", str(folder), refusal=form.refusal_of(folder)))


def split_folder(root: Path) -> Path:
    """`root` itself when it holds images or velodyne, else its training/ or testing/."""
    if not root.is_dir():
        raise UsageError(f"no such folder: {root} (expected a KITTI object folder with training/ or testing/ in it)")
    for folder in (root, root / "training", root / "testing"):
        if any((folder / name).is_dir() for name in (*_LAYOUT["image"][0], "velodyne")):
            return folder
    raise UsageError(
        f"{root}: expected training/ (or testing/) with image_2/, velodyne/ and calib/; found none of them"
    )


def open_frame(where: str, parts: Mapping[str, PartFiles], form: CloudForm, frame_id: str) -> Frame:
    """One frame of a training/ or testing/ folder; nothing is read yet."""
    image = parts["image"].path(frame_id)
    camera = 0 if parts["image"].folder.name == "image_0" else 2
    loaders: dict[str, Callable[[], Any]] = {
        "image": partial(read_image, image),
        "image_size": partial(image_size, image),
        "points": partial(read_velodyne, parts["points"].path(frame_id), form),
        "calibration": partial(read_calibration, parts["calibration"].path(frame_id), camera),
    }
    optional: dict[str, Callable[[Path], Any]] = {
        "labels": read_labels,
        "target_depth": read_depth_png,
        "semantics": read_semantics,
        "instances": read_instances,
    }
    paths = {part: parts[part].path(frame_id) for part in optional}
    loaders.update({part: partial(read, paths[part]) for part, read in optional.items() if paths[part].is_file()})
    return Frame(frame_id, loaders, where)


def read_labels(path: str | Path, scored: bool = False) -> list[KittiObject]:
    """The objects of a label file, or of a result file with `scored`. Raises DataError naming the line and column."""
    path = Path(path)
    what = "a KITTI result file" if scored else "a KITTI label file"
    text = read_text(path, what)
    try:
        return parse_lines(text, where=path.name, scored=scored)
    except ValueError as error:
        raise DataError(path, what, str(error)) from None


def read_semantics(path: str | Path) -> NDArray[np.uint8]:
    """(H, W) uint8 Cityscapes trainIds, 255 = none."""
    labels = read_unchanged(path, "an 8-bit label PNG")
    if labels.dtype != np.uint8 or labels.ndim != 2:
        raise DataError(path, "an (H, W) 8-bit label PNG", f"shape {labels.shape} {labels.dtype}")
    return labels


def read_instances(path: str | Path) -> NDArray[np.int32]:
    """(H, W) int32 instance numbers, 0 = none, from an 8- or 16-bit PNG."""
    labels = read_unchanged(path, "an instance PNG")
    if labels.ndim != 2:
        raise DataError(path, "an (H, W) instance PNG", f"shape {labels.shape}")
    return labels.astype(np.int32)


def write_frame(folder: Path, frame: Frame) -> list[Path]:
    """Writes every part that `frame` has into a training/ folder; returns the files, each complete or absent."""
    name = frame.id
    written: list[Path] = []

    def target(part_folder: str, suffix: str) -> Path:
        written.append(folder / part_folder / f"{name}{suffix}")
        return written[-1]

    if frame.has("image"):
        write_bytes(target("image_2", ".png"), png_bytes(frame.image))
    if frame.has("points"):
        write_velodyne(target("velodyne", ".bin"), frame.points)
    if frame.has("calibration"):
        write_calibration(target("calib", ".txt"), frame.calibration)
    if frame.has("labels"):
        write_objects(target("label_2", ".txt"), frame.labels)
    if frame.has("target_depth"):
        write_depth_png(target("depth_2", ".png"), frame.target_depth)
    if frame.has("semantics"):
        write_bytes(target("semantic_2", ".png"), png_bytes(frame.semantics))
    if frame.has("instances"):
        write_bytes(target("instance_2", ".png"), png_bytes(frame.instances.astype(np.uint16)))
    return written


def write_velodyne(path: Path, points: NDArray[np.floating]) -> None:
    """(N, C) points as little-endian float32, row by row: C = 4 for LiDAR, 5 for the augmented clouds of a run."""
    write_bytes(path, np.ascontiguousarray(points, dtype="<f4").tobytes())


def write_calibration(path: Path, calibration: Calibration) -> None:
    """A KITTI object calibration file (P0-P3, R0_rect, Tr_velo_to_cam, Tr_imu_to_velo)."""
    write_text(path, format_calibration(calibration))


def write_objects(path: Path, objects: Iterable[KittiObject]) -> None:
    """A label file, or a result file when the objects have scores; empty when there are none."""
    write_text(path, "".join(format_line(item) + "\n" for item in objects))
