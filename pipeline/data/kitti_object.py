"""KITTI object detection layout: reader and writer.

    ROOT/training/{image_2,velodyne,calib,label_2}/ID.{png|jpg,bin,txt,txt}      ROOT/ImageSets/{train,val,...}.txt

Beyond the official folders, synthetic data may hold `depth_2` (dense true depth, 16-bit PNG), `semantic_2` (uint8
Cityscapes trainIds) and `instance_2` (uint16, 0 = none); they are read when present. Source: KITTI object devkit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from auglidar_base.atomic import write_bytes, write_text
from detection.kitti_format import KittiObject, format_line, parse_lines
from pipeline.base.errors import DataError, UsageError
from pipeline.base.files import read_bytes, read_text
from pipeline.data.dataset import Dataset
from pipeline.data.depth_png import png_bytes, read_depth_png, write_depth_png
from pipeline.data.frame import Frame
from pipeline.data.images import image_size, read_image, read_unchanged
from pipeline.geometry.calibration import Calibration, format_calibration, read_calibration

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
# Folders whose files make a frame: a frame that lacks one of them is reported when it is used, not left out silently.
_FRAME_FOLDERS = ("image_2", "velodyne", "calib")
# A return farther than this is damage: the sensor ends at 120 m.
MAX_COORDINATE = 10_000.0


def open_kitti_object(root: str | Path) -> Dataset:
    """The frames of a KITTI object folder, sorted by id.

    root  the folder that holds training/ (or testing/), or such a folder itself
    Raises UsageError when there is no such folder or no frame in it.
    """
    folder = split_folder(Path(root))
    found = {path.stem for name in _FRAME_FOLDERS for path in _files(folder / name)}
    if not found:
        raise UsageError(f"{folder}: no frame found (expected files in image_2/, velodyne/ and calib/)")
    return Dataset(tuple(sorted(found)), partial(open_frame, folder), "kitti_object", str(folder))


def split_folder(root: Path) -> Path:
    """`root` itself when it holds image_2 or velodyne, else its training/ or testing/."""
    if not root.is_dir():
        raise UsageError(f"no such folder: {root} (expected a KITTI object folder with training/ or testing/ in it)")
    for folder in (root, root / "training", root / "testing"):
        if any((folder / name).is_dir() for name in ("image_2", "velodyne")):
            return folder
    raise UsageError(
        f"{root}: expected training/ (or testing/) with image_2/, velodyne/ and calib/; found none of them"
    )


def _files(folder: Path) -> Iterable[Path]:
    """The files of a folder (none when it does not exist), hidden ones left out."""
    if not folder.is_dir():
        return ()
    return (path for path in folder.iterdir() if not path.name.startswith("."))


def open_frame(folder: Path, frame_id: str) -> Frame:
    """One frame of a training/ or testing/ folder; nothing is read yet."""
    image = image_path(folder, frame_id)
    loaders: dict[str, Callable[[], Any]] = {
        "image": partial(read_image, image),
        "image_size": partial(image_size, image),
        "points": partial(read_velodyne, folder / "velodyne" / f"{frame_id}.bin"),
        "calibration": partial(read_calibration, folder / "calib" / f"{frame_id}.txt"),
    }
    optional: dict[str, tuple[Callable[[Path], Any], Path]] = {
        "labels": (read_labels, folder / "label_2" / f"{frame_id}.txt"),
        "target_depth": (read_depth_png, folder / "depth_2" / f"{frame_id}.png"),
        "semantics": (read_semantics, folder / "semantic_2" / f"{frame_id}.png"),
        "instances": (read_instances, folder / "instance_2" / f"{frame_id}.png"),
    }
    loaders.update({part: partial(read, path) for part, (read, path) in optional.items() if path.is_file()})
    return Frame(frame_id, loaders, str(folder))


def image_path(folder: Path, frame_id: str) -> Path:
    """The image of a frame, PNG or JPEG; the PNG path when there is none."""
    paths = [folder / "image_2" / f"{frame_id}{suffix}" for suffix in IMAGE_SUFFIXES]
    return next((path for path in paths if path.is_file()), paths[0])


def read_velodyne(path: str | Path) -> NDArray[np.float32]:
    """(N, 4) float32 x y z intensity in the LiDAR frame, metres.

    Raises DataError when the file is missing, empty, not a multiple of 16 bytes, or holds NaN, infinite or absurdly
    distant coordinates.
    """
    path = Path(path)
    what = "a velodyne cloud (float32 x y z intensity)"
    data = read_bytes(path, what)
    if len(data) % 16:
        hint = "it is truncated, or it has other columns (nuScenes has 5, plain XYZ has 3)"
        raise DataError(path, f"{what}: a multiple of 16 bytes", f"{len(data)} bytes", hint)
    points = np.frombuffer(data, dtype="<f4").reshape(-1, 4).astype(np.float32)
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        found = (
            f"{int(bad.sum())} of {len(points)} points with NaN or infinite values (first: point {int(bad.argmax())})"
        )
        raise DataError(path, f"{what} of finite numbers", found)
    largest = float(np.abs(points[:, :3]).max())
    if largest > MAX_COORDINATE:
        raise DataError(
            path, f"coordinates within {MAX_COORDINATE:g} m", f"{largest:g} m", "is it float32 x y z intensity?"
        )
    return points


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


def write_split(root: Path, name: str, frame_ids: Iterable[str]) -> None:
    """ROOT/ImageSets/NAME.txt, one id a line."""
    write_text(root / "ImageSets" / f"{name}.txt", "".join(f"{frame_id}\n" for frame_id in frame_ids))
