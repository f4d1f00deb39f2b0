"""SFD (Wu et al., CVPR 2022): completed depth and coloured pseudo points.

    depth_dense_twise/ID.png             uint16, metres x 256
    depth_pseudo_rgbseguv_twise/ID.bin   float32 N x 9: x y z (LiDAR frame, m), r g b (0..255), seg (1), u, v

u and v are column and row in the full image. Depth keeps the full image by default; compat `crop` cuts the map to the
352 x 1216 bottom-centre window, `top96` empties everything above the lowest 256 rows, as TWISE's published maps are.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from auglidar_base.atomic import write_bytes
from pipeline.data.depth_png import depth_png_bytes
from pipeline.export.kitti_tree import write_kitti_frame
from pipeline.export.record import Options, Record
from pipeline.export.source import ExportFrame
from pipeline.geometry.back_project import depth_pixels, pixels_to_velo

CROP = (352, 1216)
PREDICTED_ROWS = 256


def write_frame(item: ExportFrame, out: Path, options: Options) -> Record:
    """One frame: KITTI files of the measured cloud, the depth map and the pseudo points."""
    folder = out / "training"
    depth, top, left = quirky_depth(item.completed.depth, options.compat)
    write_bytes(folder / "depth_dense_twise" / f"{item.name}.png", depth_png_bytes(depth))
    points = pseudo_points(item, depth, top, left) if options.virtual == "dense" else filtered_points(item)
    write_bytes(folder / "depth_pseudo_rgbseguv_twise" / f"{item.name}.bin", points.tobytes())
    write_kitti_frame(item.without_run, folder, options)
    return Record(counts={"points": len(points)})


def quirky_depth(depth: NDArray[np.float32], compat: frozenset[str]) -> tuple[NDArray[np.float32], int, int]:
    """The depth map of a frame with the chosen quirks, and (top, left) of its first pixel in the full image."""
    height, width = depth.shape
    if "top96" in compat:
        depth = depth.copy()
        depth[: max(height - PREDICTED_ROWS, 0)] = 0
    if "crop" not in compat:
        return depth, 0, 0
    # An image smaller than the window is padded with 'no value': its corner then lies at a negative position.
    top, left = height - CROP[0], round((width - CROP[1]) / 2)
    window = np.zeros(CROP, np.float32)
    rows = slice(max(top, 0), height)
    columns = slice(max(left, 0), min(left + CROP[1], width))
    window[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = depth[rows, columns]
    return window, top, left


def pseudo_points(item: ExportFrame, depth: NDArray[np.float32], top: int, left: int) -> NDArray[np.float32]:
    """(N, 9) float32 of every pixel with a value."""
    u, v, z = depth_pixels(depth)
    u, v = u + left, v + top
    xyz = pixels_to_velo(u, v, z, item.frame.calibration)
    return _with_colour(item, xyz, u, v)


def filtered_points(item: ExportFrame) -> NDArray[np.float32]:
    """(N, 9) float32 of the completed points that the augmentation kept; u, v are their pixels."""
    xyz = item.virtual[:, :3].astype(np.float64)
    calibration = item.frame.calibration
    pixels, _ = calibration.cam_to_image(calibration.velo_to_cam(xyz))
    height, width = item.frame.image_size
    u, v = np.rint(pixels[:, 0]).clip(0, width - 1), np.rint(pixels[:, 1]).clip(0, height - 1)
    return _with_colour(item, xyz, u, v)


def _with_colour(item: ExportFrame, xyz: NDArray[np.float64], u: np.ndarray, v: np.ndarray) -> NDArray[np.float32]:
    colour = item.frame.image[v.astype(np.int64), u.astype(np.int64)]
    return np.ascontiguousarray(np.column_stack([xyz, colour, np.ones(len(xyz)), u, v]), dtype="<f4")
