"""KITTI depth completion: reader of the train/val tree, the selected val and test folders, and single-frame folders.

Three layouts are recognised (Uhrig et al. 2017; depth devkit):

    tree       {train,val}/DRIVE_sync/proj_depth/{groundtruth,velodyne_raw}/image_0{2,3}/%010d.png, also below
               data_depth_annotated/ and data_depth_velodyne/; images from the raw drives (DAY/DRIVE_sync/...)
    selection  {groundtruth_depth,velodyne_raw,image,intrinsics}/ as in depth_selection/val_selection_cropped
    folders    FRAME/{image.png, groundtruth_depth.png, velodyne_raw.png, intrinsics.txt}, one folder per frame

The tree is enumerated from its ground truth and every other path is derived from that name: drives lack ground truth
for their first and last five frames, so listing two folders side by side would pair wrong frames.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.errors import DataError, UsageError
from pipeline.base.files import read_text
from pipeline.data.dataset import Dataset
from pipeline.data.depth_png import read_depth_png
from pipeline.data.frame import Frame
from pipeline.data.images import image_size, read_image
from pipeline.data.kitti_object import read_velodyne
from pipeline.data.kitti_raw import DAY_LENGTH, raw_image_path, read_day_calibration
from pipeline.geometry.calibration import Calibration
from pipeline.geometry.key_values import KeyValues

Loaders = dict[str, Callable[[], Any]]

SPLITS = ("train", "val")
CAMERAS = ("image_02", "image_03")
# Where people keep the raw drives beside the depth maps, tried in this order.
_RAW_FOLDERS = (".", "raw", "kitti_raw", "raw_data")


def open_kitti_depth(root: str | Path) -> Dataset:
    """Frames of a KITTI depth completion folder, sorted by id.

    root  tree (ids "val/DRIVE_sync/image_02/0000000005"), selection folder (ids "DRIVE_sync_0000000005_image_02", test:
          "0000000000"), `depth_selection` itself with one selection in it, or a folder of single-frame folders
    Raises UsageError when none of the layouts is found.
    """
    folder = Path(root)
    if not folder.is_dir():
        raise UsageError(f"no such folder: {folder} (expected a KITTI depth completion folder)")
    for find, opener in (
        (_tree_ids, open_tree_frame),
        (_selection_ids, open_selected_frame),
        (_folder_ids, open_folder),
    ):
        ids = find(folder)
        if ids:
            return Dataset(tuple(sorted(ids)), partial(opener, folder), "kitti_depth", str(folder))
    selections = [sub for sub in sorted(folder.glob("*selection*")) if sub.is_dir() and _selection_ids(sub)]
    if len(selections) == 1:
        return open_kitti_depth(selections[0])
    raise UsageError(
        f"{folder}: no KITTI depth frame found (expected train/ or val/ with DRIVE_sync/proj_depth/groundtruth, "
        "or image/ with velodyne_raw/, or FRAME/groundtruth_depth.png)"
    )


# ---- tree ---------------------------------------------------------------------------------------------------------


def _base(root: Path, kind: str) -> Path:
    """The folder with train/ and val/ of one kind: the zip's own name when it is there, else the root."""
    named = root / {"groundtruth": "data_depth_annotated", "velodyne_raw": "data_depth_velodyne"}[kind]
    return named if named.is_dir() else root


def _tree_ids(root: Path) -> list[str]:
    base = _base(root, "groundtruth")
    return [
        f"{split}/{drive.name}/{camera}/{path.stem}"
        for split in SPLITS
        for drive in sorted(base.glob(f"{split}/*_sync"))
        for camera in CAMERAS
        for path in (drive / "proj_depth" / "groundtruth" / camera).glob("*.png")
    ]


def open_tree_frame(root: Path, frame_id: str) -> Frame:
    """The frame "SPLIT/DRIVE_sync/CAMERA/FRAME"; image, calibration and cloud need its raw drive."""
    split, drive, camera, name = frame_id.split("/")

    def depth_path(kind: str) -> Path:
        return _base(root, kind) / split / drive / "proj_depth" / kind / camera / f"{name}.png"

    target = depth_path("groundtruth")
    # The size comes from the map itself, so that frames without their raw drive are still usable.
    loaders: Loaders = {"target_depth": partial(read_depth_png, target), "image_size": partial(image_size, target)}
    if depth_path("velodyne_raw").is_file():
        loaders["sparse_depth"] = partial(read_depth_png, depth_path("velodyne_raw"))
    image = tree_image_path(root, split, drive, camera, name)
    if image is not None:
        loaders["image"] = partial(read_image, image)
    day = _raw_day(root, drive)
    if day is not None:
        loaders["calibration"] = partial(camera_calibration, day, camera)
        cloud = day / drive / "velodyne_points" / "data" / f"{name}.bin"
        if cloud.is_file():
            loaders["points"] = partial(read_velodyne, cloud)
    return Frame(frame_id, loaders, str(root))


def _raw_day(root: Path, drive: str) -> Path | None:
    """The day folder with the calibration of a drive, or None."""
    days = [root / folder / drive[:DAY_LENGTH] for folder in _RAW_FOLDERS]
    return next((day for day in days if (day / "calib_cam_to_cam.txt").is_file()), None)


def tree_image_path(root: Path, split: str, drive: str, camera: str, name: str) -> Path | None:
    """The colour image of a ground truth file: raw drive, `data_rgb`, or copied into the drive; None when absent."""
    drives = [root / folder / drive[:DAY_LENGTH] / drive for folder in _RAW_FOLDERS]
    drives.append(root / split / drive)
    paths = [raw_image_path(folder, camera, name) for folder in drives]
    copies = root / "data_rgb" / split / drive
    paths += [raw_image_path(copies, camera, name), copies / camera / f"{name}.png"]
    return next((path for path in paths if path.is_file()), None)


def camera_calibration(day: Path, camera: str) -> Calibration:
    """The day's calibration with `camera` (image_02 or image_03) as the colour image."""
    calibration = read_day_calibration(day)
    if camera == "image_02":
        return calibration
    if calibration.P3 is None:
        raise DataError(day / "calib_cam_to_cam.txt", "a line 'P_rect_03:' for image_03", "none")
    return Calibration(calibration.P3, calibration.R0_rect, calibration.T_cam0_velo)


# ---- selected val and test ----------------------------------------------------------------------------------------


def _selection_ids(root: Path) -> list[str]:
    return [selected_id(path.stem) for path in (root / "image").glob("*.png")]


def selected_id(stem: str) -> str:
    """Id of an image of the selection: its name without the kind in the middle (DRIVE_sync_image_FRAME_image_02)."""
    return stem.replace("_sync_image_", "_sync_", 1)


def selected_path(root: Path, kind: str, frame_id: str) -> Path:
    """The file of a kind (image, velodyne_raw, groundtruth_depth, intrinsics) of a selected frame.

    The kind stands in the middle of the selected val names; test names are the bare frame number. Intrinsics go by the
    image's name.
    """
    suffix, word = (".txt", "image") if kind == "intrinsics" else (".png", kind)
    return root / kind / (frame_id.replace("_sync_", f"_sync_{word}_", 1) + suffix)


def open_selected_frame(root: Path, frame_id: str) -> Frame:
    """A frame of val_selection_cropped or test_depth_completion_anonymous (352 x 1216, test without ground truth)."""
    return _loose_frame(
        root,
        frame_id,
        image=selected_path(root, "image", frame_id),
        sparse=selected_path(root, "velodyne_raw", frame_id),
        target=selected_path(root, "groundtruth_depth", frame_id),
        intrinsics=selected_path(root, "intrinsics", frame_id),
    )


# ---- one folder per frame -----------------------------------------------------------------------------------------


def _folder_ids(root: Path) -> list[str]:
    return [path.parent.name for path in root.glob("*/groundtruth_depth.png")]


def open_folder(root: Path, frame_id: str) -> Frame:
    """A frame that has its own folder."""
    folder = root / frame_id
    return _loose_frame(
        root,
        frame_id,
        image=folder / "image.png",
        sparse=folder / "velodyne_raw.png",
        target=folder / "groundtruth_depth.png",
        intrinsics=folder / "intrinsics.txt",
    )


def _loose_frame(root: Path, frame_id: str, *, image: Path, sparse: Path, target: Path, intrinsics: Path) -> Frame:
    """A frame whose files do not depend on a recording day; parts without a file are not offered."""
    loaders: Loaders = {"image": partial(read_image, image), "image_size": partial(image_size, image)}
    if sparse.is_file():
        loaders["sparse_depth"] = partial(read_depth_png, sparse)
    if target.is_file():
        loaders["target_depth"] = partial(read_depth_png, target)
    if intrinsics.is_file():
        loaders["calibration"] = partial(read_intrinsics, intrinsics)
    return Frame(frame_id, loaders, str(root))


def read_intrinsics(path: Path) -> Calibration:
    """A text file of nine numbers (row-major 3 x 3 camera matrix) as a calibration; see `camera_only`."""
    text = read_text(path, "nine numbers of a camera matrix")
    return camera_only(KeyValues({"camera matrix": (1, text)}, path).matrix(("camera matrix",), (3, 3)))


# LiDAR axes (x forward, y left, z up) -> camera axes (x right, y down, z forward).
AXES_CAM_VELO = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def camera_only(K: np.ndarray) -> Calibration:
    """The calibration of data without a LiDAR: points lie in LiDAR axes with the origin in the camera's centre."""
    T_cam0_velo = np.eye(4)
    T_cam0_velo[:3, :3] = AXES_CAM_VELO
    return Calibration(P2=np.column_stack([K, np.zeros(3)]), R0_rect=np.eye(3), T_cam0_velo=T_cam0_velo)


# ---- crops --------------------------------------------------------------------------------------------------------


def official_crop(size: tuple[int, int], crop: tuple[int, int] = (352, 1216)) -> tuple[int, int]:
    """(top, left) of the benchmark's bottom-centre crop of an image of `size` (height, width).

    left = round((W - 1216) / 2) as in the selected val set. Raises ValueError when the image is smaller than the crop.
    """
    height, width = size
    if height < crop[0] or width < crop[1]:
        raise ValueError(f"image {height} x {width} is smaller than the crop {crop[0]} x {crop[1]}")
    return height - crop[0], round((width - crop[1]) / 2)


def cropped_frame(frame: Frame, crop: tuple[int, int] = (352, 1216)) -> Frame:
    """The same frame cut to the bottom-centre crop: image, maps and calibration (not cloud and 3D labels)."""
    top, left = official_crop(frame.image_size, crop)
    window = np.s_[top : top + crop[0], left : left + crop[1]]
    maps = ("image", "sparse_depth", "target_depth", "semantics", "instances")
    loaders: Loaders = dict(frame.loaders)
    loaders.update({part: partial(_window, frame, part, window) for part in maps if frame.has(part)})
    loaders["image_size"] = partial(tuple, crop)
    if frame.has("calibration"):
        loaders["calibration"] = lambda: frame.calibration.cropped(top, left)
    return Frame(frame.id, loaders, frame.where)


def _window(frame: Frame, part: str, window: tuple[slice, slice]) -> np.ndarray:
    return np.ascontiguousarray(getattr(frame, part)[window])
