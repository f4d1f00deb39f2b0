"""OpenPCDet: KITTI folders with info pickles and ground truth database, and the custom layout.

    openpcdet         training/{velodyne,calib,label_2}, ImageSets/, kitti_infos_SPLIT.pkl, kitti_dbinfos_train.pkl,
                      gt_database/ID_CLASS_I.bin (points relative to the box centre)
    openpcdet_custom  points/ID.npy, labels/ID.txt (x y z dx dy dz heading class), ImageSets/

Field names, shapes and dtypes follow pcdet/datasets/kitti/kitti_dataset.py and custom_dataset.py of OpenPCDet 0.6.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from auglidar_base.atomic import write_bytes, write_text
from detection.boxes import wrap_angle
from detection.kitti_format import KittiObject, boxes_of
from pipeline.data.kitti_object import write_velodyne
from pipeline.export.disk_buffer import DiskBuffer, write_streamed
from pipeline.export.geometry import boxes_in_lidar, points_in_box
from pipeline.export.kitti_tree import care_first, square, write_kitti_frame
from pipeline.export.pickles import item_opcodes, write_dict_of_lists, write_list
from pipeline.export.record import Options, Record
from pipeline.export.source import ExportFrame
from pipeline.geometry.reference_in_view import in_view_openpcdet

INFOS, DATABASE = "infos", "database/"


def write_kitti(item: ExportFrame, out: Path, options: Options) -> Record:
    """One frame of `openpcdet`: its KITTI files, its info entry and, for training frames, its database objects."""
    count = write_kitti_frame(item, out / "training", options)
    info = frame_info(item)
    entries = [(INFOS, item_opcodes(info))]
    if "annos" in info and item.train:
        entries += _database_entries(item, info, out)
    boxes = len(info["annos"]["gt_boxes_lidar"]) if "annos" in info else 0
    return Record(tuple(entries), {"points": count, "boxes": boxes})


def frame_info(item: ExportFrame) -> dict[str, Any]:
    """The entry of kitti_infos_SPLIT.pkl: point_cloud, image, calib and, with labels, annos."""
    calibration = item.frame.calibration
    info: dict[str, Any] = {
        "point_cloud": {"num_features": 4, "lidar_idx": item.name},
        "image": {"image_idx": item.name, "image_shape": np.array(item.frame.image_size, dtype=np.int32)},
        "calib": {
            "P2": square(calibration.P2),
            "R0_rect": square(calibration.R0_rect),
            "Tr_velo_to_cam": calibration.T_cam0_velo.copy(),
        },
    }
    if item.frame.has("labels"):
        info["annos"] = frame_annotations(item)
    return info


def frame_annotations(item: ExportFrame) -> dict[str, Any]:
    """`annos` of one frame; dimensions are l h w, gt_boxes_lidar has no DontCare."""
    objects = care_first(item.frame.labels)
    cared = [o for o in objects if o.type != "DontCare"]
    rows = boxes_of(objects).values
    lidar = boxes_in_lidar(boxes_of(cared), item.frame.calibration)
    inside = np.full(len(objects), -1, dtype=np.int32)
    visible = item.points[in_view_openpcdet(item.points, item.frame.calibration, item.frame.image_size)]
    inside[: len(cared)] = [int(points_in_box(visible, box).sum()) for box in lidar]
    return {
        "name": np.array([o.type for o in objects]),
        "truncated": np.array([o.truncated for o in objects]),
        "occluded": np.array([float(o.occluded) for o in objects]),
        "alpha": np.array([o.alpha for o in objects]),
        "bbox": np.array([o.bbox for o in objects], dtype=np.float32).reshape(-1, 4),
        "dimensions": rows[:, [5, 3, 4]],
        "location": rows[:, :3].astype(np.float32),
        "rotation_y": rows[:, 6].copy(),
        "score": np.full(len(objects), -1.0),
        "difficulty": np.array([difficulty(o) for o in objects], dtype=np.int32),
        "index": np.array([i if i < len(cared) else -1 for i in range(len(objects))], dtype=np.int32),
        "gt_boxes_lidar": lidar,
        "num_points_in_gt": inside,
    }


def difficulty(item: KittiObject) -> int:
    """0 easy, 1 moderate, 2 hard, -1 none, by OpenPCDet's rule (2D height counted inclusively: + 1)."""
    height = item.height_2d + 1
    for level, (pixels, truncated, occluded) in enumerate(((40, 0.15, 0), (25, 0.3, 1), (25, 0.5, 2))):
        if height >= pixels and item.truncated <= truncated and item.occluded <= occluded:
            return level
    return -1


def _database_entries(item: ExportFrame, info: dict[str, Any], out: Path) -> Iterator[tuple[str, bytes]]:
    """Writes gt_database/ID_CLASS_I.bin per object and yields its entry of kitti_dbinfos_train.pkl."""
    annos = info["annos"]
    for index, box in enumerate(annos["gt_boxes_lidar"]):
        name = str(annos["name"][index])
        inside = item.points[points_in_box(item.points, box)]
        relative = inside.copy()
        relative[:, :3] -= box[:3].astype(np.float32)
        path = f"gt_database/{item.name}_{name}_{index}.bin"
        write_velodyne(out / path, relative)
        entry = {
            "name": name,
            "path": path,
            "image_idx": item.name,
            "gt_idx": index,
            "box3d_lidar": box,
            "num_points_in_gt": len(inside),
            "difficulty": int(annos["difficulty"][index]),
            "bbox": annos["bbox"][index],
            "score": float(annos["score"][index]),
        }
        yield f"{DATABASE}{name}", item_opcodes(entry)


def finish_kitti(
    out: Path, buffers: Mapping[str, DiskBuffer], names: list[str], splits: Mapping[str, frozenset[str]]
) -> list[Path]:
    """kitti_infos_SPLIT.pkl of every split and kitti_dbinfos_train.pkl from the frames' entries."""
    written = []
    for split, members in splits.items():
        path = out / f"kitti_infos_{split}.pkl"
        infos = (entry for name, entry in zip(names, buffers[INFOS]) if name in members) if names else iter(())
        write_streamed(path, lambda file, infos=infos: write_list(file, infos))  # type: ignore[misc]
        written.append(path)
    classes = [name for name in buffers if name.startswith(DATABASE)]
    path = out / "kitti_dbinfos_train.pkl"
    lists = [(name.removeprefix(DATABASE), buffers[name]) for name in classes]
    write_streamed(path, lambda file: write_dict_of_lists(file, {}, lists))
    return [*written, path]


def write_custom(item: ExportFrame, out: Path, options: Options) -> Record:
    """One frame of `openpcdet_custom`: N x 4 points (every column with compat `all_columns`) and boxes as text."""
    values = item.columns.values if "all_columns" in options.compat else item.points
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(values, dtype=np.float32), allow_pickle=False)
    write_bytes(out / "points" / f"{item.name}.npy", buffer.getvalue())
    boxes = 0
    if item.frame.has("labels"):
        cared = [o for o in item.frame.labels if o.type != "DontCare"]
        lidar = boxes_in_lidar(boxes_of(cared), item.frame.calibration)
        lidar[:, 6] = wrap_angle(lidar[:, 6])
        lines = [" ".join(f"{v:.4f}" for v in box) + f" {o.type}\n" for box, o in zip(lidar, cared)]
        write_text(out / "labels" / f"{item.name}.txt", "".join(lines))
        boxes = len(cared)
    return Record(counts={"points": len(values), "boxes": boxes})
