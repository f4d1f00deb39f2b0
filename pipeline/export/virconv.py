"""VirConv and TED (Wu et al., CVPR 2023 and AAAI 2023): measured and virtual points in one array.

    velodyne_depth/ID.npy   float16 N x 8: x y z (LiDAR frame, m) | intensity x 10 (measured), 0 (virtual)
                            | r/3 g/3 b/3 (virtual), 0 (measured) | 1 virtual, 2 measured; measured rows first

Virtual points: z < 1 m, more than 1.5 rad from the vertical, one per 0.002 x 0.002 rad cell, by default the nearest.
Geometry is correct for every image size; compat `window352` keeps the top-left 352 x 1216 window that the original
generator looks at, `lowest_z` takes the lowest point of a cell as it does, `float32` keeps full precision (float16
rounds by up to 3 cm beyond 64 m; the loader takes either).
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from auglidar_base.atomic import write_bytes
from pipeline.export.kitti_tree import write_kitti_frame
from pipeline.export.record import Options, Record
from pipeline.export.source import ExportFrame
from pipeline.geometry.back_project import depth_pixels, pixels_to_velo
from pipeline.geometry.reference_in_view import in_view_openpcdet

WINDOW = (352, 1216)
CELL = 0.002
MAX_HEIGHT = 1.0
MIN_POLAR = 1.5
VIRTUAL, MEASURED = 1.0, 2.0
INTENSITY_SCALE, COLOUR_SCALE = 10.0, 3.0


def write_frame(item: ExportFrame, out: Path, options: Options) -> Record:
    """One frame: KITTI files of the measured cloud and training/velodyne_depth/NAME.npy."""
    rows = velodyne_depth(item, options)
    stored = rows if "float32" in options.compat else rows.astype(np.float16)
    buffer = io.BytesIO()
    np.save(buffer, stored, allow_pickle=False)
    write_bytes(out / "training" / "velodyne_depth" / f"{item.name}.npy", buffer.getvalue())
    write_kitti_frame(item.without_run, out / "training", options)
    loss = float(np.abs(stored[:, :3].astype(np.float32) - rows[:, :3]).max()) if len(rows) else 0.0
    return Record(counts={"points": len(rows)}, largest={"rounding of coordinates (m)": loss})


def velodyne_depth(item: ExportFrame, options: Options) -> NDArray[np.float32]:
    """(N, 8) float32 rows of a frame, measured points first."""
    window = WINDOW if "window352" in options.compat else item.frame.image_size
    points = item.frame.points if item.frame.has("points") else np.zeros((0, 4), np.float32)
    points = points[in_view_openpcdet(points, item.frame.calibration, window)]
    nothing = np.zeros((len(points), 3), np.float32)
    flag = np.full(len(points), MEASURED, np.float32)
    measured = np.column_stack([points[:, :3], points[:, 3] * np.float32(INTENSITY_SCALE), nothing, flag])
    return np.concatenate([measured, virtual_rows(item, options, window)]).astype(np.float32)


def virtual_rows(item: ExportFrame, options: Options, window: tuple[int, int]) -> NDArray[np.float32]:
    """(N, 8) float32 rows of the virtual points."""
    calibration = item.frame.calibration
    if options.virtual == "dense":
        u, v, z = depth_pixels(item.completed.depth)
        xyz = pixels_to_velo(u, v, z, calibration)
    else:
        xyz = item.virtual[:, :3].astype(np.float64)
        u, v = calibration.cam_to_image(calibration.velo_to_cam(xyz))[0].T
    height, width = item.frame.image_size
    column, row = np.rint(u).astype(np.int64).clip(0, width - 1), np.rint(v).astype(np.int64).clip(0, height - 1)
    keep = np.flatnonzero((column < window[1]) & (row < window[0]))
    keep = keep[one_per_cell(xyz[keep], "lowest_z" in options.compat)]
    colour = item.frame.image[row[keep], column[keep]].astype(np.float32) / np.float32(COLOUR_SCALE)
    return np.column_stack([xyz[keep], np.zeros(len(keep)), colour, np.full(len(keep), VIRTUAL)]).astype(np.float32)


def one_per_cell(xyz: NDArray[np.float64], lowest_z: bool) -> NDArray[np.int64]:
    """Indices of the points kept by the spherical sampling, in the order of the input.

    xyz       (N, 3) LiDAR points in metres
    lowest_z  keep the lowest point of a cell (the original's choice) instead of the nearest
    """
    distance = np.linalg.norm(xyz, axis=1)
    polar = np.arccos(np.divide(xyz[:, 2], distance, out=np.ones_like(distance), where=distance > 0))
    candidates = np.flatnonzero((xyz[:, 2] < MAX_HEIGHT) & (polar > MIN_POLAR))
    azimuth = np.arctan2(xyz[candidates, 1], xyz[candidates, 0])
    cells = np.floor(np.column_stack([polar[candidates], azimuth]) / CELL).astype(np.int64)
    key = cells[:, 0] * 10_000 + cells[:, 1] - cells[:, 1].min(initial=0)
    order = np.lexsort((xyz[candidates, 2] if lowest_z else distance[candidates], key))
    first = np.ones(len(order), dtype=bool)
    first[1:] = key[order][1:] != key[order][:-1]
    return np.sort(candidates[order[first]])
