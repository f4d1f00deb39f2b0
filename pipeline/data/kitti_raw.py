"""KITTI raw drives: reader.

    ROOT/DAY/calib_cam_to_cam.txt, calib_velo_to_cam.txt
    ROOT/DAY/DRIVE_sync/image_02/data/%010d.png      ROOT/DAY/DRIVE_sync/velodyne_points/data/%010d.bin

Ids are "DRIVE_sync/FRAME" (left colour camera; the right one's matrix is `calibration.P3`).
Frames are enumerated from the images; some drives lack clouds (2011_09_26_drive_0009 has none for 177-180), such frames
have no `points`. Source: Geiger et al., "Vision meets Robotics", 2013, and the raw data devkit.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.base.errors import UsageError
from pipeline.base.files import read_text
from pipeline.data.dataset import Dataset
from pipeline.data.frame import Frame
from pipeline.data.images import image_size, read_image
from pipeline.data.kitti_object import read_velodyne
from pipeline.geometry.calibration import Calibration, parse_raw_calibration

DAY_LENGTH = len("2011_09_26")
IMAGE_SUFFIXES = (".png", ".jpg")


def open_kitti_raw(root: str | Path) -> Dataset:
    """Frames of every drive under `root` (the folder of the days, or one day), left colour camera, sorted.

    Raises UsageError when no drive with images is found.
    """
    folder = Path(root)
    # Given one day's folder, its drives lie directly below; `day_folder` finds them from either.
    drives = sorted([*folder.glob("*_sync"), *folder.glob("????_??_??/*_sync")], key=lambda drive: drive.name)
    ids = [f"{drive.name}/{name}" for drive in drives for name in image_names(drive, "image_02")]
    if not ids:
        raise UsageError(f"{folder}: no KITTI raw frame found (expected DAY/DRIVE_sync/image_02/data/%010d.png)")
    return Dataset(tuple(ids), partial(open_frame, folder), "kitti_raw", str(folder))


def image_names(drive: Path, camera: str) -> list[str]:
    """Frame names of one camera of a drive, sorted."""
    folder = drive / camera / "data"
    return sorted(p.stem for p in folder.iterdir() if p.suffix in IMAGE_SUFFIXES) if folder.is_dir() else []


def day_folder(root: Path, drive: str) -> Path:
    """The folder that holds the drive and its day's calibration: ROOT/DAY, or ROOT when that is a day itself."""
    dated = root / drive[:DAY_LENGTH]
    return dated if dated.is_dir() else root


def open_frame(root: Path, frame_id: str) -> Frame:
    """The frame "DRIVE_sync/FRAME"; nothing is read yet."""
    drive, _, name = frame_id.partition("/")
    day = day_folder(root, drive)
    image = raw_image_path(day / drive, "image_02", name)
    cloud = day / drive / "velodyne_points" / "data" / f"{name}.bin"
    loaders: dict[str, Callable[[], Any]] = {
        "image": partial(read_image, image),
        "image_size": partial(image_size, image),
        "calibration": partial(read_day_calibration, day),
    }
    if cloud.is_file():
        loaders["points"] = partial(read_velodyne, cloud)
    return Frame(frame_id, loaders, str(root))


def raw_image_path(drive: Path, camera: str, name: str) -> Path:
    """The image of a camera, PNG or JPEG; the PNG path when there is none."""
    paths = [drive / camera / "data" / f"{name}{suffix}" for suffix in IMAGE_SUFFIXES]
    return next((path for path in paths if path.is_file()), paths[0])


def read_day_calibration(day: Path) -> Calibration:
    """Calibration of a recording day (left colour camera as P2, right one as P3). Raises DataError when incomplete."""
    names = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt")
    cameras, velodyne = (read_text(day / name, "a KITTI raw calibration file") for name in names)
    return parse_raw_calibration(cameras, velodyne, day)
