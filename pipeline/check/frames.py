"""Examination of one frame of a data set: every part by itself, then the parts against each other.

Runs in a worker process; gives back the findings and the few numbers that are compared over all frames.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detection.kitti_format import KittiObject, boxes_of
from pipeline.base.errors import DataError
from pipeline.check.calibrations import calibration_key, check_calibration, check_family
from pipeline.check.clouds import CloudFacts, check_cloud, cloud_facts, read_raw_cloud
from pipeline.check.depths import check_depth, file_fault, read_map
from pipeline.check.faults import Finding
from pipeline.check.images import CROP_SHIFTS, Structure, colours_swapped, shift_gains, structure
from pipeline.check.labels import check_objects, read_objects, wide_lines
from pipeline.data.cloud_columns import CloudForm
from pipeline.data.cloud_files import read_measured
from pipeline.data.frame import Frame
from pipeline.export.geometry import boxes_in_lidar, points_in_box
from pipeline.geometry.calibration import Calibration
from pipeline.geometry.project import project_points

Points = NDArray[np.float32]

# Layouts whose frames are street scenes, where sky and leaves tell red from blue.
OUTDOOR = frozenset({"kitti_object", "kitti_depth", "kitti_raw"})
# Layouts whose depth maps are KITTI PNGs (metres x 256); the others go through their reader.
_KITTI_DEPTH = frozenset({"kitti_object", "kitti_depth", "folder"})
_HASHED = ("image", "points", "labels")
# A labelled object this near has returns on it, whatever the LiDAR.
_NEAR = 25.0
_FEWEST_RETURNS = 5
# Gain of a crop shift that is believed from one frame alone; smaller ones are averaged over the frames.
_CERTAIN_GAIN = 0.1
# Share of a frame's near objects that must hold returns before another reading of the data is believed.
_CERTAIN = 0.8
# Labelled objects stand on the road; farther from it, the origin of the cloud is not where the calibration has it.
_SHIFT = 0.8
# Horizontal axes in the orders that occur: the vertical one is judged from the cloud alone.
_TURNS = {
    "y x z": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]]),
    "x -y z": np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 1]]),
    "y -x z": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "-y x z": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}


@dataclass(frozen=True)
class Place:
    """A frame to examine: its id, the ids before and after it, and the data set's layout."""

    frame: str
    neighbours: tuple[str, ...]
    layout: str


@dataclass(frozen=True)
class FrameFacts:
    """Findings of one frame and what is compared over the frames (see `pipeline.check.datasets`)."""

    frame: str
    findings: tuple[Finding, ...]
    declared: frozenset[str] = frozenset()
    present: frozenset[str] = frozenset()
    hashes: tuple[tuple[str, bytes], ...] = ()
    cloud: CloudFacts | None = None
    size: tuple[int, int] | None = None
    rig: tuple[float, ...] | None = None
    structure: Structure | None = None
    gains: tuple[float, ...] = ()
    cars: tuple[int, int] = (0, 0)
    label_columns: int = 0
    empty_points: int = 0


@dataclass
class _Parts:
    """What could be read of a frame, filled part by part; a part with a fault stays None."""

    frame: Frame
    findings: list[Finding] = field(default_factory=list)
    size: tuple[int, int] | None = None
    image: NDArray[np.uint8] | None = None
    calibration: Calibration | None = None
    points: Points | None = None
    objects: list[KittiObject] = field(default_factory=list)
    empty: int = 0

    def where(self, part: str) -> str:
        path = source_path(self.frame, part)
        return str(path) if path is not None else f"{self.frame.where} {self.frame.id}"

    def load(self, part: str, load: Callable[[], Any] | None = None) -> Any:
        """A part through its reader, or None with a finding."""
        try:
            return getattr(self.frame, part) if load is None else load()
        except DataError as error:
            fault = file_fault(error)
            # Absent files are judged over all frames (`datasets.Comparison`): missing here, or extra there?
            if fault != "missing_file":
                message = f"expected {error.expected}, got {error.found}"
                self.findings.append(Finding(fault, self.frame.id, self.where(part), message))
            return None


def source_path(frame: Frame, part: str) -> Path | None:
    """The file behind a part: the path that the reader bound to the part's loader, if it bound one."""
    loader = frame.loaders.get(part)
    arguments = getattr(loader, "args", ())
    # Readers of tables bind a folder, derived parts another loader: such a part has no file of its own.
    if any(isinstance(argument, partial) for argument in arguments):
        return None
    paths = [argument for argument in arguments if isinstance(argument, Path) and not argument.is_dir()]
    return paths[-1] if paths else None


def _argument(frame: Frame, part: str, default: Any, kind: type) -> Any:
    """The argument of a kind that the reader bound to the part's loader: how the files of this data set are read."""
    arguments = getattr(frame.loaders.get(part), "args", ())
    return next((argument for argument in arguments if isinstance(argument, kind)), default)


def open_present(open_frame: Callable[[str], Frame], frame_id: str) -> Frame:
    """A frame without the parts whose whole folder is absent: an export without images is not 7481 missing files."""
    frame = open_frame(frame_id)
    paths = {part: source_path(frame, part) for part in frame.loaders}
    loaders = {p: load for p, load in frame.loaders.items() if (path := paths[p]) is None or path.parent.is_dir()}
    return Frame(frame.id, loaders, frame.where)


def examine_frame(open_frame: Callable[[str], Frame], place: Place) -> FrameFacts:
    """Every check of one frame. Never raises for damage in the frame's files."""
    frame = open_frame(place.frame)
    parts = _Parts(frame)
    _read_image(parts, place.layout)
    _read_calibration(parts, place.layout)
    _read_cloud(parts)
    _read_labels(parts)
    _check_placement(parts, open_frame, place)
    _check_depths(parts, open_frame, place)
    cars = [o for o in parts.objects if o.type == "Car"]
    maps = None
    if parts.image is not None and parts.points is not None and parts.calibration is not None:
        maps = structure(parts.image, parts.points, parts.calibration)
    gains = () if maps is None else shift_gains(maps)
    if gains and max(gains) > _CERTAIN_GAIN:
        rows, columns = (4 * cells for cells in CROP_SHIFTS[int(np.argmax(gains))])
        message = f"image and cloud fit when the image is moved by about {-rows} rows and {-columns} columns"
        parts.findings.append(Finding("wrong_crop", frame.id, parts.where("image"), message))
    return FrameFacts(
        frame=frame.id,
        findings=tuple(parts.findings),
        declared=frozenset(frame.loaders),
        present=frozenset(part for part in frame.loaders if _is_there(frame, part)),
        hashes=tuple(_hashes(frame)),
        cloud=None if parts.points is None else cloud_facts(parts.points),
        size=parts.size,
        rig=None if parts.calibration is None else calibration_key(parts.calibration),
        structure=maps,
        gains=gains,
        cars=(sum(o.size[0] > o.size[1] for o in cars), len(cars)),
        label_columns=_label_columns(frame),
        empty_points=parts.empty,
    )


def _label_columns(frame: Frame) -> int:
    path = source_path(frame, "labels")
    return wide_lines(path) if path is not None and path.suffix.lower() == ".txt" and path.is_file() else 0


def _is_there(frame: Frame, part: str) -> bool:
    path = source_path(frame, part)
    return path is None or path.is_file()


def _hashes(frame: Frame) -> Iterator[tuple[str, bytes]]:
    """Digests of the files that never are equal in two frames (labels: only with an object in them)."""
    for part in _HASHED:
        path = source_path(frame, part)
        if path is None or not path.is_file():
            continue
        data = path.read_bytes()
        if part == "labels" and not any(line and not line.startswith(b"DontCare") for line in data.splitlines()):
            continue
        if data:
            yield part, hashlib.blake2b(data, digest_size=16).digest()


# ---- parts by themselves ------------------------------------------------------------------------------------------


def _read_image(parts: _Parts, layout: str) -> None:
    if not parts.frame.has("image"):
        parts.size = parts.load("image_size") if parts.frame.has("image_size") else None
        return
    parts.image = parts.load("image")
    if parts.image is None:
        return
    parts.size = (parts.image.shape[0], parts.image.shape[1])
    evidence = colours_swapped(parts.image) if layout in OUTDOOR else None
    if evidence is not None:
        message = (
            f"sky is redder than blue by {-evidence[0]:.0f}, leaves bluer than red by {-evidence[1]:.1f} grey levels"
        )
        parts.findings.append(Finding("rgb_bgr_swap", parts.frame.id, parts.where("image"), message))


def _read_calibration(parts: _Parts, layout: str) -> None:
    frame = parts.frame
    path = source_path(frame, "calibration")
    if not frame.has("calibration"):
        return
    if path is not None and path.is_file() and path.stat().st_size == 0:
        parts.findings.append(Finding("empty_file", frame.id, str(path), "0 bytes"))
        return
    if layout == "kitti_object" and path is not None and path.is_file():
        found = check_family(path, frame.id, _argument(frame, "calibration", 2, int))
        parts.findings += found
        if found:
            return
    calibration = parts.load("calibration")
    if calibration is None:
        return
    found = check_calibration(calibration, frame.id, parts.where("calibration"), parts.size)
    if not found and calibration.T_cam_velo[2, 0] < -0.5 and layout != "folder":
        message = f"LiDAR 'forward' maps to camera z {calibration.T_cam_velo[2, 0]:.2f}, expected near 1"
        found = [Finding("wrong_extrinsics", frame.id, parts.where("calibration"), message)]
    if not found and calibration.T_cam_velo[1, 2] > -0.5 and layout != "folder":
        message = f"LiDAR 'up' maps to camera y {calibration.T_cam_velo[1, 2]:.2f}, expected near -1"
        found = [Finding("wrong_extrinsics", frame.id, parts.where("calibration"), message)]
    parts.findings += found
    parts.calibration = None if found else calibration


def _read_cloud(parts: _Parts) -> None:
    frame = parts.frame
    if not frame.has("points"):
        return
    path = source_path(frame, "points")
    if path is not None and path.suffix.lower() == ".bin" and path.is_file():
        points, found = read_raw_cloud(path, _argument(frame, "points", CloudForm(), CloudForm), frame.id)
        parts.findings += found
    elif path is not None and path.suffix.lower() in (".ply", ".pcd"):
        form = _argument(frame, "points", CloudForm(), CloudForm)
        points, parts.empty = parts.load("points", partial(read_measured, path, form)) or (None, 0)
    else:
        points = parts.load("points")
    if points is None:
        return
    found = check_cloud(points, frame.id, parts.where("points"))
    parts.findings += found
    parts.points = None if found else points


def _read_labels(parts: _Parts) -> None:
    frame = parts.frame
    if not frame.has("labels"):
        return
    path = source_path(frame, "labels")
    if path is not None and path.suffix.lower() == ".txt":
        objects, found = read_objects(path, frame.id, scored=False)
    else:
        objects, found = parts.load("labels") or [], []
    if not found:
        found = check_objects(objects, frame.id, parts.where("labels"), parts.calibration, parts.size)
    parts.findings += found
    parts.objects = [] if found else objects


# ---- parts against each other -------------------------------------------------------------------------------------


def _check_placement(parts: _Parts, open_frame: Callable[[str], Frame], place: Place) -> None:
    """Labelled boxes must hold points; if none does, the axes or the frame are wrong."""
    if parts.points is None or parts.calibration is None:
        return
    near = [o for o in parts.objects if _has_returns(o)]
    if not near or _held(near, parts.points, parts.calibration) > 0:
        return
    frame, where = parts.frame.id, parts.where("labels")
    shift = _height_of_labels(near, parts.points, parts.calibration)
    if abs(shift) > _SHIFT and _held(near, parts.points[:, :3] + [0, 0, shift], parts.calibration) > _CERTAIN:
        message = f"labelled objects stand {shift:+.2f} m above the road and hold points only when the cloud is moved"
        parts.findings.append(Finding("shifted_cloud", frame, parts.where("points"), message))
        return
    for name, turn in _TURNS.items():
        if _held(near, (parts.points[:, :3] @ turn.T), parts.calibration) > _CERTAIN:
            message = f"labelled objects hold points only when the columns are read as {name}"
            parts.findings.append(Finding("axis_order", frame, parts.where("points"), message))
            return
    for other in place.neighbours:
        cloud = _cloud_of(open_frame, other)
        if cloud is not None and _held(near, cloud, parts.calibration) > _CERTAIN:
            message = f"its labels fit the cloud of frame {other}"
            parts.findings.append(Finding("index_offset", frame, where, message))
            return
    message = f"no point in {len(near)} labelled objects nearer than {_NEAR:g} m"
    parts.findings.append(Finding("labels_disagree_with_cloud", frame, where, message))


def _has_returns(item: KittiObject) -> bool:
    visible = item.occluded in (0, 1) and 0 <= item.truncated < 0.3
    return visible and item.type in ("Car", "Van", "Truck", "Pedestrian", "Cyclist") and 4 < item.location[2] < _NEAR


def _height_of_labels(objects: list[KittiObject], points: NDArray[np.floating], calibration: Calibration) -> float:
    """Metres by which the objects' bottoms lie above the road, the lowest points as near as they are."""
    boxes = boxes_in_lidar(boxes_of(objects), calibration)
    distance = np.hypot(points[:, 0], points[:, 1])
    around = points[(distance > 4) & (distance < _NEAR), 2]
    if len(around) == 0:
        return 0.0
    return float(np.median(boxes[:, 2] - boxes[:, 5] / 2) - np.percentile(around, 10))


def _held(objects: list[KittiObject], points: NDArray[np.floating], calibration: Calibration) -> float:
    """Share of the objects with returns in the upper part of their boxes, where no road is."""
    boxes = boxes_in_lidar(boxes_of(objects), calibration)
    boxes[:, 2] += 0.15 * boxes[:, 5]
    boxes[:, 5] *= 0.7
    return float(np.mean([points_in_box(points, box).sum() >= _FEWEST_RETURNS for box in boxes]))


def _cloud_of(open_frame: Callable[[str], Frame], frame_id: str) -> Points | None:
    try:
        return open_frame(frame_id).points
    except DataError:
        # The neighbour's own examination reports what is wrong with it.
        return None


def _lidar_of(open_frame: Callable[[str], Frame], frame_id: str) -> NDArray[np.float32] | None:
    """The LiDAR map of another frame, or None when it cannot be made."""
    try:
        frame = open_frame(frame_id)
        return project_points(frame.points, frame.calibration, frame.image_size)
    except DataError:
        return None


def _check_depths(parts: _Parts, open_frame: Callable[[str], Frame], place: Place) -> None:
    """Stored depth maps: readable, of the image's size, and in line with the LiDAR (or with the sparse map)."""
    maps = {}
    for part in ("sparse_depth", "target_depth"):
        if not parts.frame.has(part):
            continue
        path = source_path(parts.frame, part)
        if place.layout in _KITTI_DEPTH and path is not None:
            depth, found = read_map(path, parts.frame.id)
            parts.findings += found
        else:
            depth = parts.load(part)
        if depth is not None:
            maps[part] = depth
    reference = None
    if parts.points is not None and parts.calibration is not None and parts.size is not None:
        reference = project_points(parts.points, parts.calibration, parts.size)
    for part, depth in maps.items():
        other = maps.get("sparse_depth") if reference is None and part == "target_depth" else reference
        if other is not None:
            near = [(name, partial(_lidar_of, open_frame, name)) for name in place.neighbours]
            found = check_depth(depth, other, parts.calibration, parts.frame.id, parts.where(part), near)
            parts.findings += found
        elif parts.size is not None and depth.shape != parts.size:
            message = f"map of {depth.shape[1]} x {depth.shape[0]}, image of {parts.size[1]} x {parts.size[0]}"
            parts.findings.append(Finding("wrong_crop", parts.frame.id, parts.where(part), message))
