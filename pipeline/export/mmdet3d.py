"""mmdetection3d: KITTI folders with `velodyne_reduced` and info files of version 1.1.

    training/{velodyne,velodyne_reduced,calib,label_2}, ImageSets/, kitti_infos_SPLIT.pkl = {metainfo, data_list}

Field names follow tools/dataset_converters/update_infos_to_v2.py and kitti_converter.py of mmdetection3d 1.4.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from detection.kitti_format import KittiObject, boxes_of
from pipeline.data.kitti_object import write_velodyne
from pipeline.export.disk_buffer import DiskBuffer, write_streamed
from pipeline.export.geometry import boxes_in_lidar, points_in_box
from pipeline.export.kitti_tree import care_first, square, write_kitti_frame
from pipeline.export.pickles import item_opcodes, write_dict_of_lists
from pipeline.export.record import Options, Record
from pipeline.export.source import ExportFrame
from pipeline.geometry.reference_in_view import in_view_mmdet3d

CATEGORIES = {
    "Pedestrian": 0,
    "Cyclist": 1,
    "Car": 2,
    "Van": 3,
    "Truck": 4,
    "Person_sitting": 5,
    "Tram": 6,
    "Misc": 7,
}
INFOS = "infos"


def write_frame(item: ExportFrame, out: Path, options: Options) -> Record:
    """One frame: its KITTI files, the points in the image as velodyne_reduced, and its entry of data_list."""
    count = write_kitti_frame(item, out / "training", options)
    visible = item.points[in_view_mmdet3d(item.points, item.frame.calibration, item.frame.image_size)]
    write_velodyne(out / "training" / "velodyne_reduced" / f"{item.name}.bin", visible)
    info = frame_info(item, visible)
    counts = {"points": count, "boxes": len(info.get("instances", ()))}
    return Record(((INFOS, item_opcodes(info)),), counts)


def frame_info(item: ExportFrame, visible: np.ndarray) -> dict[str, Any]:
    """The entry of data_list; `visible` (N, 4) are the points of velodyne_reduced."""
    calibration = item.frame.calibration
    height, width = item.frame.image_size
    rectify, T_cam0_velo = square(calibration.R0_rect), calibration.T_cam0_velo
    lidar2cam = rectify @ T_cam0_velo
    grey = square(np.column_stack([calibration.K, np.zeros(3)]))
    P3 = calibration.P2 if calibration.P3 is None else calibration.P3
    images: dict[str, Any] = {}
    for camera, matrix in (("CAM0", grey), ("CAM1", grey), ("CAM2", square(calibration.P2)), ("CAM3", square(P3))):
        images[camera] = {"cam2img": matrix.tolist(), "lidar2img": (matrix @ lidar2cam).tolist()}
    images["CAM2"] |= {
        "img_path": f"{item.name}.png",
        "height": height,
        "width": width,
        "lidar2cam": lidar2cam.tolist(),
    }
    images["R0_rect"] = rectify.tolist()
    info: dict[str, Any] = {
        "sample_idx": int(item.name),
        "images": images,
        "lidar_points": {
            "num_pts_feats": 4,
            "lidar_path": f"{item.name}.bin",
            "Tr_velo_to_cam": T_cam0_velo.tolist(),
            "Tr_imu_to_velo": np.eye(4).tolist(),
        },
        "plane": None,
    }
    if item.frame.has("labels"):
        info["instances"] = instances(item, visible)
        keys = ("bbox_label", "bbox_label_3d", "bbox", "bbox_3d", "center_2d", "depth")
        cared = (entry for entry in info["instances"] if entry["index"] >= 0)
        info["cam_instances"] = {"CAM2": [{"bbox_3d_isvalid": True} | {k: e[k] for k in keys} for e in cared]}
    return info


def instances(item: ExportFrame, visible: np.ndarray) -> list[dict[str, Any]]:
    """`instances` of a frame, DontCare last with label -1; bbox_3d is camera x y z (bottom centre) l h w ry."""
    objects = care_first(item.frame.labels)
    lidar = boxes_in_lidar(boxes_of(objects), item.frame.calibration)
    return [_instance(o, index, lidar[index], item, visible) for index, o in enumerate(objects)]


def _instance(
    item: KittiObject, index: int, box: np.ndarray, source: ExportFrame, visible: np.ndarray
) -> dict[str, Any]:
    x, y, z = item.location
    h, w, l = item.size
    care = item.type != "DontCare"
    centre = np.array([[x, y - h / 2, z]])
    pixels, depth = source.frame.calibration.cam_to_image(centre)
    label = CATEGORIES.get(item.type, -1)
    return {
        "bbox": [float(value) for value in item.bbox],
        "bbox_label": label,
        "bbox_3d": [float(value) for value in (x, y, z, l, h, w, item.ry)],
        "bbox_label_3d": label,
        "depth": float(depth[0]),
        "center_2d": [float(value) for value in pixels[0]],
        "num_lidar_pts": int(points_in_box(visible, box).sum()) if care else -1,
        "difficulty": difficulty(item),
        "truncated": float(item.truncated),
        "occluded": int(item.occluded),
        "alpha": float(item.alpha),
        "score": 0.0 if item.score is None else float(item.score),
        "index": index if care else -1,
        "group_id": index,
    }


def difficulty(item: KittiObject) -> int:
    """0 easy, 1 moderate, 2 hard, -1 none, by mmdetection3d's rule (2D height must exceed the limit)."""
    for level, (pixels, truncated, occluded) in enumerate(((40, 0.15, 0), (25, 0.3, 1), (25, 0.5, 2))):
        if item.height_2d > pixels and item.truncated <= truncated and item.occluded <= occluded:
            return level
    return -1


def finish(
    out: Path, buffers: Mapping[str, DiskBuffer], names: list[str], splits: Mapping[str, frozenset[str]]
) -> list[Path]:
    """kitti_infos_SPLIT.pkl of every split."""
    metainfo = {"categories": CATEGORIES, "dataset": "kitti", "info_version": "1.1"}
    written = []
    for split, members in splits.items():
        path = out / f"kitti_infos_{split}.pkl"
        entries = [(name in members) for name in names]
        infos = (entry for keep, entry in zip(entries, buffers[INFOS]) if keep) if names else iter(())
        lists = [("data_list", infos)]
        write_streamed(path, lambda file, lists=lists: write_dict_of_lists(file, {"metainfo": metainfo}, lists))  # type: ignore[misc]
        written.append(path)
    return written
