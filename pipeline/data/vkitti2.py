"""Virtual KITTI 2.0.3: reader of all scenes, variations and both cameras.

    SceneXX/VARIATION/frames/{rgb,depth,classSegmentation,instanceSegmentation}/Camera_{0,1}/...      (files per frame)
    SceneXX/VARIATION/{colors,intrinsic,extrinsic,info,bbox,pose}.txt                               (one row per object)

Each archive may also lie in a folder of its own name (vkitti_2.0.3_rgb/SceneXX/...). Ids are
"Scene01/clone/Camera_0/00000". Depth is stored in centimetres; 65535 (sky, far plane) is no value. There is no LiDAR:
points of this data set live in LiDAR axes with the origin in the camera's centre (`kitti_depth.camera_only`).
Source: Cabon et al., "Virtual KITTI 2", 2020, and the data set's format page.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detection.kitti_format import KittiObject
from pipeline.base.errors import DataError, UsageError
from pipeline.data.dataset import Dataset
from pipeline.data.depth_png import read_depth_png
from pipeline.data.frame import Frame
from pipeline.data.images import check_complete, image_size, read_bytes, read_image, read_unchanged
from pipeline.data.kitti_depth import camera_only
from pipeline.data.lidar_like import depth_points, sample_like_lidar
from pipeline.data.vkitti2_text import (
    VkittiObject,
    frame_numbers,
    objects_of_frame,
    part_folder,
    read_camera_rows,
    read_colors,
    text_folder,
)
from pipeline.geometry.calibration import Calibration

SCENES = ("Scene01", "Scene02", "Scene06", "Scene18", "Scene20")
VARIATIONS = (
    "clone",
    "fog",
    "morning",
    "overcast",
    "rain",
    "sunset",
    "15-deg-left",
    "15-deg-right",
    "30-deg-left",
    "30-deg-right",
)
CAMERAS = ("Camera_0", "Camera_1")
# Thesis chapters 4 and 5: trained on the clone of four scenes, tested on the fifth.
TRAIN_SCENES, TEST_SCENES = SCENES[:4], SCENES[4:]
INVALID_DEPTH = 65535
# Camera_1 stands this far to the right of Camera_0, metres.
BASELINE = 0.532725
# Category of colors.txt -> Cityscapes trainId. GuardRail and Misc have no counterpart among the 19 classes.
TRAIN_IDS = {
    "Terrain": 9,
    "Sky": 10,
    "Tree": 8,
    "Vegetation": 8,
    "Building": 2,
    "Road": 0,
    "GuardRail": 255,
    "TrafficSign": 7,
    "TrafficLight": 6,
    "Pole": 5,
    "Misc": 255,
    "Truck": 14,
    "Car": 13,
    "Van": 13,
    "Undefined": 255,
}
# From an occlusion fraction to KITTI's levels 0 (fully visible), 1 (partly), 2 (largely); limits of the thesis, ch. 5.
PARTLY_OCCLUDED, LARGELY_OCCLUDED = 0.1, 0.6


def looks_like_vkitti2(root: Path) -> bool:
    """Whether a folder holds a scene, or an archive unpacked into its own folder."""
    return any(any(root.glob(sign)) for sign in ("Scene[0-9][0-9]", "vkitti_2.0.3_*"))


def open_vkitti2(root: str | Path) -> Dataset:
    """Every frame under `root`, all variations and cameras found, in the order of scene, variation, camera, frame.

    Choose with `.select("Scene20/clone/*")` or `thesis_split`. Raises UsageError when nothing is found.
    """
    folder = Path(root)
    ids: list[str] = []
    for scene in SCENES:
        for variation in VARIATIONS:
            for camera in CAMERAS:
                rgb = part_folder(folder, "rgb", scene, variation) / "frames" / "rgb" / camera
                names = sorted(path.stem.removeprefix("rgb_") for path in rgb.glob("rgb_*.jpg"))
                ids.extend(f"{scene}/{variation}/{camera}/{name}" for name in names)
    if not ids:
        raise UsageError(f"{folder}: no Virtual KITTI 2 frame found (expected SceneXX/VARIATION/frames/rgb/Camera_0/)")
    return Dataset(tuple(ids), partial(open_frame, folder), "vkitti2", str(folder))


def thesis_split(dataset: Dataset, name: str) -> Dataset:
    """A split of the thesis: "train" (clone of scenes 01, 02, 06, 18, both cameras), "test" (scene 20 clone, both
    cameras, every frame: chapter 5) or "test_completion" (scene 20 clone, left camera, every other frame: chapter 4).
    """
    wanted = {
        "train": (TRAIN_SCENES, CAMERAS, 1),
        "test": (TEST_SCENES, CAMERAS, 1),
        "test_completion": (TEST_SCENES, CAMERAS[:1], 2),
    }
    if name not in wanted:
        raise UsageError(f"unknown Virtual KITTI 2 split {name!r}; choose one of {', '.join(wanted)}")
    scenes, cameras, step = wanted[name]
    parts = [(frame_id, frame_id.split("/")) for frame_id in dataset.ids]
    return dataset.select(
        [
            frame_id
            for frame_id, (scene, variation, camera, number) in parts
            if scene in scenes and variation == "clone" and camera in cameras and int(number) % step == 0
        ]
    )


def frame_path(root: Path, frame_id: str, part: str, prefix: str, suffix: str) -> Path:
    """The file of one part of a frame; the folder's name is also accepted in lower case."""
    scene, variation, camera, number = frame_id.split("/")
    frames = part_folder(root, part, scene, variation) / "frames"
    folder = frames / part
    if not folder.is_dir() and (frames / part.lower()).is_dir():
        folder = frames / part.lower()
    return folder / camera / f"{prefix}_{number}{suffix}"


def open_frame(root: Path, frame_id: str) -> Frame:
    """One frame; nothing is read yet. Parts whose file is absent are not offered."""
    rgb = frame_path(root, frame_id, "rgb", "rgb", ".jpg")
    text = text_folder(root, frame_id)
    intrinsic = text / "intrinsic.txt"
    loaders: dict[str, Callable[[], Any]] = {"image": partial(read_image, rgb), "image_size": partial(image_size, rgb)}
    files: dict[str, tuple[Callable[[Path], Any], Path]] = {
        "target_depth": (read_depth, frame_path(root, frame_id, "depth", "depth", ".png")),
        "semantics": (partial(_semantics, text), frame_path(root, frame_id, "classSegmentation", "classgt", ".png")),
        "instances": (read_instances, frame_path(root, frame_id, "instanceSegmentation", "instancegt", ".png")),
        "sparse_depth": (read_depth_png, sampled_depth_path(root, frame_id)),
    }
    for part, (reader, path) in files.items():
        if path.is_file():
            loaders[part] = partial(reader, path)
    if intrinsic.is_file():
        loaders["calibration"] = partial(read_intrinsic, intrinsic, frame_id)
        if "target_depth" in loaders and "sparse_depth" not in loaders:
            loaders["sparse_depth"] = partial(_sampled, intrinsic, frame_id, files["target_depth"][1])
        if "sparse_depth" in loaders:
            loaders["points"] = partial(_sampled_points, intrinsic, frame_id, loaders["sparse_depth"])
    if (text / "bbox.txt").is_file() and (text / "pose.txt").is_file():
        loaders["labels"] = partial(read_labels, root, frame_id)
    return Frame(frame_id, loaders, str(root))


def _sampled(intrinsic: Path, frame_id: str, depth: Path) -> NDArray[np.float32]:
    """(H, W) metres of a 64-row LiDAR-like subsampling of the dense depth (`lidar_like.sample_like_lidar`)."""
    return sample_like_lidar(read_depth(depth), read_intrinsic(intrinsic, frame_id))


def _sampled_points(intrinsic: Path, frame_id: str, sparse: Callable[[], Any]) -> NDArray[np.float32]:
    """(N, 4) the sparse depth as a cloud, intensity 0."""
    return depth_points(sparse(), read_intrinsic(intrinsic, frame_id))


def sampled_depth_path(root: Path, frame_id: str) -> Path:
    """A stored LiDAR-like subsampling (KITTI depth PNG), in the folder names of the TWISE authors."""
    scene, variation, camera, number = frame_id.split("/")
    return root / "sampled_depth" / scene / variation / "frames" / "64R_sampled" / camera / f"depth_{number}.png"


def read_depth(path: str | Path) -> NDArray[np.float32]:
    """(H, W) float32 metres from a PNG in centimetres; 0 where the file has 0 or 65535 (sky, beyond the far plane)."""
    code = read_unchanged(path, "a Virtual KITTI 2 depth PNG (uint16 centimetres)")
    if code.dtype != np.uint16 or code.ndim != 2:
        hint = "was the file re-saved by an image viewer?"
        raise DataError(path, "a one-channel 16-bit PNG in centimetres", f"shape {code.shape} {code.dtype}", hint)
    depth = code.astype(np.float32) / np.float32(100)
    depth[code == INVALID_DEPTH] = 0
    return depth


def read_instances(path: str | Path) -> NDArray[np.int32]:
    """(H, W) int32, trackID + 1, 0 = no object, from the indexed PNG (its palette is not decoded)."""
    from PIL import Image

    data = read_bytes(Path(path), "an instance PNG (indexed)")
    check_complete(data, Path(path))
    # OpenCV expands a palette to colours; Pillow gives the indices, which are what the data set stores.
    with Image.open(io.BytesIO(data)) as image:
        indices = np.asarray(image)
    if indices.ndim != 2:
        raise DataError(path, "an indexed or grey PNG (trackID + 1)", f"shape {indices.shape}", "was it re-coloured?")
    return indices.astype(np.int32)


def _semantics(text: Path, path: Path) -> NDArray[np.uint8]:
    return colors_to_train_ids(read_image(path), read_colors(text / "colors.txt"), path)


def colors_to_train_ids(
    image: NDArray[np.uint8], colors: dict[str, tuple[int, int, int]], where: str | Path
) -> NDArray[np.uint8]:
    """(H, W, 3) RGB class image -> (H, W) uint8 Cityscapes trainIds (255 = none) by the table of colors.txt.

    Moving and parked cars have the class colour here; their track is in the instance image. Raises DataError when more
    than 1 % of the pixels have a colour that is not in the table (a re-compressed or BGR image).
    """
    packed = (image[..., 0].astype(np.int32) << 16) | (image[..., 1].astype(np.int32) << 8) | image[..., 2]
    keys = {(r << 16) | (g << 8) | b: TRAIN_IDS.get(name, 255) for name, (r, g, b) in colors.items()}
    order = np.array(sorted(keys))
    index = np.searchsorted(order, packed).clip(0, len(order) - 1)
    known = order[index] == packed
    if not known.all() and (~known).mean() > 0.01:
        found = f"{100 * float((~known).mean()):.1f} % of the pixels in other colours"
        raise DataError(where, "colours of colors.txt", found, "was it re-saved as JPEG, or with red and blue swapped?")
    values = np.array([keys[int(key)] for key in order], dtype=np.uint8)
    return np.where(known, values[index], 255).astype(np.uint8)


def read_intrinsic(path: Path, frame_id: str) -> Calibration:
    """Camera matrix of intrinsic.txt as a calibration without LiDAR; P3 is the right camera for frames of Camera_0."""
    frame, camera = frame_numbers(frame_id)
    row = read_camera_rows(path, 4).get((frame, camera))
    if row is None:
        raise DataError(path, f"a row for frame {frame} camera {camera}", "none")
    fx, fy, cx, cy = row
    calibration = camera_only(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    if camera == 1:
        return calibration
    P3 = calibration.P2.copy()
    P3[0, 3] = -fx * BASELINE
    return replace(calibration, P3=P3)


def camera_pose(root: str | Path, frame_id: str) -> NDArray[np.float64]:
    """(4, 4) T_cam_world of a frame: world -> camera (x right, y down, z forward), metres, from extrinsic.txt."""
    frame, camera = frame_numbers(frame_id)
    path = text_folder(Path(root), frame_id) / "extrinsic.txt"
    row = read_camera_rows(path, 16).get((frame, camera))
    if row is None:
        raise DataError(path, f"a row for frame {frame} camera {camera}", "none")
    return np.array(row).reshape(4, 4)


def read_objects(root: str | Path, frame_id: str) -> list[VkittiObject]:
    """The labelled objects of a frame with everything the data set says about them."""
    frame, camera = frame_numbers(frame_id)
    return objects_of_frame(text_folder(Path(root), frame_id), frame, camera)


def read_labels(root: Path, frame_id: str) -> list[KittiObject]:
    """Objects in KITTI form. The occlusion level comes from the fill rule (`vkitti2_difficulty.occlusion_by_fill`)."""
    from pipeline.data.vkitti2_difficulty import full_fill, occlusion_by_fill

    folder = text_folder(root, frame_id)
    fill = full_fill(folder)
    return [to_kitti(item, occlusion_by_fill(item, fill)) for item in read_objects(root, frame_id)]


def to_kitti(item: VkittiObject, occlusion: float) -> KittiObject:
    """One object in KITTI form; `occlusion` in [0, 1] becomes level 0, 1 or 2 at 0.1 and 0.6."""
    level = 0 if occlusion < PARTLY_OCCLUDED else 1 if occlusion <= LARGELY_OCCLUDED else 2
    left, right, top, bottom = item.box
    return KittiObject(
        type=item.label,
        truncated=item.truncation_ratio,
        occluded=level,
        alpha=item.alpha,
        bbox=(left, top, right, bottom),
        size=(item.height, item.width, item.length),
        location=item.location,
        ry=item.ry,
    )
