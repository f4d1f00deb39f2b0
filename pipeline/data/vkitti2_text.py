"""The text files of Virtual KITTI 2, one folder per scene and variation, as rows of numbers.

    bbox.txt  frame cameraID trackID left right top bottom number_pixels truncation_ratio occupancy_ratio isMoving
    pose.txt  frame cameraID trackID alpha width height length, world X Y Z, world rotation y x z,
              camera X Y Z, camera rotation y x z             (location = centre of the bottom face)
    info.txt  trackID label model color        colors.txt  Category r g b
    intrinsic.txt  frame cameraID fx fy cx cy  extrinsic.txt  frame cameraID, 16 numbers of T_cam_world row by row

A header line comes first; columns are found by position, as the format page prints them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from pipeline.base.errors import DataError
from pipeline.base.files import read_text

Key = tuple[int, int]


@dataclass(frozen=True)
class VkittiObject:
    """One object in one image.

    box               left, right, top, bottom in pixels, inclusive, in the file's order
    number_pixels     visible pixels
    truncation_ratio  0 = inside the image, 1 = entirely outside
    occupancy_ratio   number_pixels / area of the box in every published sample row: the *fill* of the box
    location          bottom centre in this camera (x right, y down, z forward), metres
    ry                radians about the camera's y axis, 0 faces +x
    """

    frame: int
    camera: int
    track: int
    label: str
    model: str
    color: str
    box: tuple[float, float, float, float]
    number_pixels: int
    truncation_ratio: float
    occupancy_ratio: float
    moving: bool
    alpha: float
    width: float
    height: float
    length: float
    location_world: tuple[float, float, float]
    location: tuple[float, float, float]
    ry: float

    @property
    def height_2d(self) -> float:
        """bottom - top in pixels."""
        return self.box[3] - self.box[2]


def objects_of_frame(folder: Path, frame: int, camera: int) -> list[VkittiObject]:
    """Objects of one image in the order of bbox.txt. Raises DataError when a track has no pose or no label."""
    return [*objects_of_folder(folder).get((frame, camera), ())]


def objects_of_folder(folder: Path) -> dict[Key, tuple[VkittiObject, ...]]:
    """(frame, camera) -> objects of a scene and variation; parsed once per version of its files."""
    stamps = tuple(
        (folder / name).stat().st_mtime_ns for name in _existing(folder, ("bbox.txt", "pose.txt", "info.txt"))
    )
    return _objects(folder, stamps)


def _existing(folder: Path, names: tuple[str, ...]) -> tuple[str, ...]:
    for name in names:
        if not (folder / name).is_file():
            raise DataError(folder / name, "a Virtual KITTI 2 text file", "no such file", "unpack vkitti_2.0.3_textgt")
    return names


# Six scenes' worth of parsed tables: walking a data set in order then parses each file once.
@lru_cache(maxsize=6)
def _objects(folder: Path, stamps: tuple[int, ...]) -> dict[Key, tuple[VkittiObject, ...]]:
    info = {row[0]: row[1:] for row in _rows(folder / "info.txt", 4)}
    poses = {tuple(row[:3]): row for row in _rows(folder / "pose.txt", 19)}
    found: dict[Key, list[VkittiObject]] = {}
    for row in _rows(folder / "bbox.txt", 11):
        pose = poses.get(tuple(row[:3]))
        if pose is None:
            raise DataError(folder / "pose.txt", f"a row for frame, camera, track {' '.join(row[:3])}", "none")
        if row[2] not in info:
            raise DataError(folder / "info.txt", f"a row for track {row[2]}", "none")
        item = _object(row, pose, info[row[2]], folder)
        found.setdefault((item.frame, item.camera), []).append(item)
    return {key: tuple(items) for key, items in found.items()}


def _object(row: list[str], pose: list[str], info: list[str], folder: Path) -> VkittiObject:
    try:
        left, right, top, bottom, pixels, truncation, occupancy = (float(word) for word in row[3:10])
        p = [float(word) for word in pose[3:]]
        frame, camera, track = (int(word) for word in row[:3])
    except ValueError as error:
        raise DataError(folder, "numbers in bbox.txt and pose.txt", str(error)) from None
    return VkittiObject(
        frame=frame,
        camera=camera,
        track=track,
        label=info[0],
        model=info[1],
        color=info[2],
        box=(left, right, top, bottom),
        number_pixels=int(pixels),
        truncation_ratio=truncation,
        occupancy_ratio=occupancy,
        moving=row[10].lower() == "true",
        alpha=p[0],
        # pose.txt gives width, height, length; KITTI gives height, width, length.
        width=p[1],
        height=p[2],
        length=p[3],
        location_world=(p[4], p[5], p[6]),
        location=(p[10], p[11], p[12]),
        ry=p[13],
    )


def _rows(path: Path, columns: int) -> list[list[str]]:
    """Rows of a text file after its header, split at blanks. Raises DataError with the line number."""
    rows = []
    for number, line in enumerate(_lines(path)[1:], start=2):
        words = line.split()
        if not words:
            continue
        if len(words) < columns:
            raise DataError(f"{path}:{number}", f"{columns} columns", f"{len(words)}")
        rows.append(words)
    return rows


def _lines(path: Path) -> list[str]:
    return read_text(path, "a Virtual KITTI 2 text file").splitlines()


def read_camera_rows(path: Path, columns: int) -> dict[Key, tuple[float, ...]]:
    """(frame, camera) -> the numbers of intrinsic.txt (4) or extrinsic.txt (16)."""
    if not path.is_file():
        raise DataError(path, "a Virtual KITTI 2 text file", "no such file", "unpack vkitti_2.0.3_textgt")
    return _camera_rows(path, columns, path.stat().st_mtime_ns)


@lru_cache(maxsize=12)
def _camera_rows(path: Path, columns: int, stamp: int) -> dict[Key, tuple[float, ...]]:
    try:
        return {
            (int(row[0]), int(row[1])): tuple(float(word) for word in row[2 : 2 + columns])
            for row in _rows(path, 2 + columns)
        }
    except ValueError as error:
        raise DataError(path, "numbers", str(error)) from None


def read_colors(path: Path) -> dict[str, tuple[int, int, int]]:
    """Category -> (r, g, b) of colors.txt."""
    try:
        return {row[0]: (int(row[1]), int(row[2]), int(row[3])) for row in _rows(path, 4)}
    except ValueError as error:
        raise DataError(path, "Category r g b", str(error)) from None


def part_folder(root: Path, part: str, scene: str, variation: str) -> Path:
    """SceneXX/VARIATION of one archive ("rgb", "depth", "textgt", ...), in its own folder or in the common one."""
    own = root / f"vkitti_2.0.3_{part}" / scene / variation
    return own if own.is_dir() else root / scene / variation


def text_folder(root: Path, frame_id: str) -> Path:
    """The folder with bbox.txt, pose.txt, ... of a frame's scene and variation."""
    scene, variation, _, _ = frame_id.split("/")
    return part_folder(root, "textgt", scene, variation)


def frame_numbers(frame_id: str) -> tuple[int, int]:
    """(frame, camera) numbers of an id, as the text files give them."""
    _, _, camera, number = frame_id.split("/")
    return int(number), int(camera.removeprefix("Camera_"))
