"""Examination of info pickles: OpenPCDet's lists and mmdetection3d's data_list, against the folders beside them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from detection.boxes import wrap_angle
from detection.kitti_format import KittiObject
from pipeline.base.errors import DataError
from pipeline.check.faults import Finding
from pipeline.check.labels import read_objects
from pipeline.check.safe_pickle import load_infos
from pipeline.export.kitti_tree import square
from pipeline.export.mmdet3d import CATEGORIES
from pipeline.geometry.calibration import Calibration, read_calibration

_TOLERANCE = 1e-3


def examine_infos(root: Path, kind: str) -> Iterator[Finding]:
    """Faults of every kitti_infos_*.pkl below `root`; kind "openpcdet" or "mmdet3d"."""
    for path in sorted(root.glob("kitti_infos_*.pkl")):
        try:
            infos = load_infos(path)
        except DataError as error:
            yield Finding("unreadable_file", "", str(path), f"expected {error.expected}, got {error.found}")
            continue
        if kind == "mmdet3d":
            yield from _examine_mmdet3d(infos, root, path)
        else:
            yield from _examine_openpcdet(infos, root, path)


def _examine_openpcdet(infos: Any, root: Path, path: Path) -> Iterator[Finding]:
    if not isinstance(infos, list):
        yield Finding("infos_disagree", "", str(path), f"expected a list of frames, got {type(infos).__name__}")
        return
    for info in infos:
        try:
            name = str(info["point_cloud"]["lidar_idx"])
            yield from _openpcdet_frame(info, name, root, path)
        except (KeyError, TypeError, IndexError, ValueError) as error:
            yield Finding("infos_disagree", "", str(path), f"an entry lacks or misshapes {error}")


def _openpcdet_frame(info: dict[str, Any], name: str, root: Path, path: Path) -> Iterator[Finding]:
    cloud = root / "training" / "velodyne" / f"{name}.bin"
    if not cloud.is_file():
        yield Finding("missing_file", name, str(cloud), f"listed in {path.name}")
        return
    calibration = _calibration(root, name)
    if calibration is not None:
        stored = {key: np.asarray(info["calib"][key]) for key in ("P2", "R0_rect", "Tr_velo_to_cam")}
        own = (square(calibration.P2), square(calibration.R0_rect), calibration.T_cam0_velo)
        for (key, matrix), expected in zip(stored.items(), own):
            if matrix.shape != (4, 4) or np.abs(matrix - expected).max() > _TOLERANCE:
                yield Finding("infos_disagree", name, str(path), f"calib {key} is not that of calib/{name}.txt")
                return
    objects = _objects(root, name)
    if objects is None or "annos" not in info:
        return
    annos = info["annos"]
    if [str(n) for n in annos["name"]] != [o.type for o in objects]:
        yield Finding("infos_disagree", name, str(path), f"annos names differ from label_2/{name}.txt")
        return
    cared = [o for o in objects if o.type != "DontCare"]
    lidar = np.asarray(annos["gt_boxes_lidar"], dtype=np.float64).reshape(-1, 7)
    if len(lidar) != len(cared):
        yield Finding("infos_disagree", name, str(path), f"{len(lidar)} gt_boxes_lidar for {len(cared)} objects")
        return
    lhw = np.asarray(annos["dimensions"], dtype=np.float64).reshape(-1, 3)[: len(cared)]
    yield from _compare_boxes(cared, lidar[:, 3:6], lidar[:, 6], lhw, name, path)


def _compare_boxes(
    objects: list[KittiObject], lwh: np.ndarray, heading: np.ndarray, lhw: np.ndarray, name: str, path: Path
) -> Iterator[Finding]:
    """Sizes and headings of info boxes against the labels."""
    if not objects:
        return
    h, w, l = np.array([o.size for o in objects]).T
    ry = np.array([o.ry for o in objects])
    if np.abs(lwh - np.column_stack([l, w, h])).max() > 0.02 or np.abs(lhw - np.column_stack([l, h, w])).max() > 0.02:
        message = "sizes are not l w h in gt_boxes_lidar and l h w in dimensions"
        yield Finding("swapped_dimensions", name, str(path), message)
    elif np.abs(wrap_angle(heading + np.pi / 2 + ry)).max() > 0.02:
        mirrored = np.abs(wrap_angle(heading - np.pi / 2 - ry)).max() < 0.02
        mirrored = mirrored or np.abs(wrap_angle(heading + np.pi / 2 - ry)).max() < 0.02
        fault = "yaw_sign" if mirrored else "infos_disagree"
        yield Finding(fault, name, str(path), "heading is not -(ry + pi/2)")


def _examine_mmdet3d(infos: Any, root: Path, path: Path) -> Iterator[Finding]:
    if isinstance(infos, list):
        yield Finding("old_info_format", "", str(path), f"a list of {len(infos)} frames: infos of mmdetection3d 1.0")
        return
    if not isinstance(infos, dict) or not {"metainfo", "data_list"} <= set(infos):
        yield Finding("infos_disagree", "", str(path), "expected {metainfo, data_list}")
        return
    categories = infos["metainfo"].get("categories") if isinstance(infos["metainfo"], dict) else None
    if categories != CATEGORIES:
        yield Finding("infos_disagree", "", str(path), f"categories {categories}, expected {CATEGORIES}")
        return
    for info in infos["data_list"]:
        try:
            yield from _mmdet3d_frame(info, root, path)
        except (KeyError, TypeError, IndexError, ValueError) as error:
            yield Finding("infos_disagree", "", str(path), f"an entry lacks or misshapes {error}")


def _mmdet3d_frame(info: dict[str, Any], root: Path, path: Path) -> Iterator[Finding]:
    name = Path(info["lidar_points"]["lidar_path"]).stem
    cloud = root / "training" / "velodyne_reduced" / f"{name}.bin"
    if not cloud.is_file():
        yield Finding("missing_file", name, str(cloud), f"listed in {path.name}")
        return
    camera = info["images"]["CAM2"]
    product = np.asarray(camera["cam2img"]) @ np.asarray(camera["lidar2cam"])
    if np.abs(product - np.asarray(camera["lidar2img"])).max() > 0.1:
        yield Finding("infos_disagree", name, str(path), "CAM2 lidar2img is not cam2img times lidar2cam")
        return
    calibration = _calibration(root, name)
    if calibration is not None and np.abs(np.asarray(camera["lidar2cam"]) - calibration.T_cam_velo).max() > _TOLERANCE:
        yield Finding("infos_disagree", name, str(path), f"lidar2cam is not that of calib/{name}.txt")
        return
    objects = _objects(root, name)
    if objects is None or "instances" not in info:
        return
    labels = [instance["bbox_label_3d"] for instance in info["instances"]]
    if labels != [CATEGORIES.get(o.type, -1) for o in objects]:
        yield Finding("infos_disagree", name, str(path), f"instance labels differ from label_2/{name}.txt")
        return
    for o, instance in zip(objects, info["instances"]):
        if o.type == "DontCare":
            continue
        x, y, z, l, h, w, ry = instance["bbox_3d"]
        if max(abs(l - o.size[2]), abs(h - o.size[0]), abs(w - o.size[1])) > 0.02:
            message = f"bbox_3d sizes {l:g} {h:g} {w:g} are not length, height, width of the label"
            yield Finding("swapped_dimensions", name, str(path), message)
            return
        if abs(float(wrap_angle(ry - o.ry))) > 0.02:
            fault = "yaw_sign" if abs(float(wrap_angle(ry + o.ry))) < 0.02 else "infos_disagree"
            yield Finding(fault, name, str(path), f"bbox_3d yaw {ry:g}, label {o.ry:g}")
            return
        if max(abs(x - o.location[0]), abs(y - o.location[1]), abs(z - o.location[2])) > 0.02:
            yield Finding("infos_disagree", name, str(path), f"bbox_3d location {x:g} {y:g} {z:g}, label {o.location}")
            return


def _calibration(root: Path, name: str) -> Calibration | None:
    try:
        return read_calibration(root / "training" / "calib" / f"{name}.txt")
    except DataError:
        # Reported by the examination of the KITTI folders themselves.
        return None


def _objects(root: Path, name: str) -> list[KittiObject] | None:
    """The label file's objects, DontCare last as info files number them; None without a (sound) file."""
    path = root / "training" / "label_2" / f"{name}.txt"
    if not path.is_file():
        return None
    objects, found = read_objects(path, name, scored=False)
    return None if found else sorted(objects, key=lambda o: o.type == "DontCare")
