"""The formats that can be exported: one readable table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.export import clouds, kitti_tree, mmdet3d, openpcdet, parquet, sfd, virconv
from pipeline.export.disk_buffer import DiskBuffer
from pipeline.export.record import Options, Record
from pipeline.export.source import ExportFrame

WriteFrame = Callable[[ExportFrame, Path, Options], Record]
Finish = Callable[[Path, Mapping[str, DiskBuffer], list[str], Mapping[str, frozenset[str]]], list[Path]]


@dataclass(frozen=True)
class Format:
    """One consumer's layout.

    write_frame  writes the files of a frame below the output folder
    summary      one line for --help
    finish       writes index files from the frames' entries, or None
    needs        part of a run without which there is nothing to export ("depth", "detections"), or "" when the data
                 set's own cloud will do
    compat       quirk name -> what it does
    splits       write ImageSets/SPLIT.txt
    """

    write_frame: WriteFrame
    summary: str
    finish: Finish | None = None
    needs: str = ""
    compat: Mapping[str, str] = field(default_factory=dict)
    splits: bool = True


_ALL_COLUMNS = {"all_columns": "write every per-point column instead of x y z intensity"}

FORMATS: dict[str, Format] = {
    "openpcdet": Format(
        openpcdet.write_kitti, "KITTI folders, kitti_infos_*.pkl, kitti_dbinfos_train.pkl", openpcdet.finish_kitti
    ),
    "openpcdet_custom": Format(openpcdet.write_custom, "points/*.npy and labels/*.txt", compat=_ALL_COLUMNS),
    "mmdet3d": Format(mmdet3d.write_frame, "KITTI folders, velodyne_reduced, info files v1.1", mmdet3d.finish),
    "sfd": Format(
        sfd.write_frame,
        "depth_dense_twise and depth_pseudo_rgbseguv_twise",
        needs="depth",
        compat={
            "crop": "depth maps cut to the 352 x 1216 bottom-centre window",
            "top96": "no depth above the lowest 256 rows",
        },
    ),
    "virconv": Format(
        virconv.write_frame,
        "velodyne_depth/*.npy of VirConv and TED",
        needs="depth",
        compat={
            "window352": "keep the top-left 352 x 1216 window only",
            "lowest_z": "keep the lowest point of a cell, not the nearest",
            "float32": "full precision instead of float16",
        },
    ),
    "kitti_bin": Format(kitti_tree.write_bin_frame, "velodyne/*.bin", compat=_ALL_COLUMNS, splits=False),
    "ply": Format(clouds.write_ply, "one PLY per frame, every column", splits=False),
    "pcd": Format(clouds.write_pcd, "one PCD per frame, every column", splits=False),
    "parquet": Format(
        parquet.write_frame, "all detections as one table", parquet.finish, needs="detections", splits=False
    ),
}
