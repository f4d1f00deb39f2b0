"""KITTI object folders with a run's cloud in place of the measured one: OpenPCDet, mmdetection3d and plain use."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from auglidar_base.atomic import write_bytes
from detection.kitti_format import KittiObject
from pipeline.data.depth_png import png_bytes
from pipeline.data.kitti_object import write_calibration, write_objects, write_velodyne
from pipeline.export.record import Options, Record
from pipeline.export.source import ExportFrame


def write_kitti_frame(item: ExportFrame, folder: Path, options: Options) -> int:
    """velodyne/, calib/, label_2/ and, when asked for, image_2/ of one frame; returns the number of points.

    The cloud has four columns, since every consumer reads `reshape(-1, 4)`. A data set without a LiDAR has none.
    """
    count = 0
    if item.run is not None or item.frame.has("points"):
        write_velodyne(folder / "velodyne" / f"{item.name}.bin", item.points)
        count = len(item.points)
    write_calibration(folder / "calib" / f"{item.name}.txt", item.frame.calibration)
    if item.frame.has("labels"):
        write_objects(folder / "label_2" / f"{item.name}.txt", care_first(item.frame.labels))
    if options.images:
        write_bytes(folder / "image_2" / f"{item.name}.png", png_bytes(item.frame.image))
    return count


def care_first(objects: list[KittiObject]) -> list[KittiObject]:
    """The objects with DontCare behind all others, as the info files number them."""
    return [o for o in objects if o.type != "DontCare"] + [o for o in objects if o.type == "DontCare"]


def write_bin_frame(item: ExportFrame, out: Path, options: Options) -> Record:
    """kitti_bin: velodyne/NAME.bin, float32 x y z intensity, or every column with compat `all_columns`."""
    values = item.columns.values if "all_columns" in options.compat else item.points
    write_velodyne(out / "velodyne" / f"{item.name}.bin", values)
    return Record(counts={"points": len(values)})


def square(matrix: np.ndarray) -> np.ndarray:
    """A 3 x 4 or 3 x 3 matrix as 4 x 4."""
    full = np.eye(4)
    full[: matrix.shape[0], : matrix.shape[1]] = matrix
    return full
