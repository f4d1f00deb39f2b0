"""Examination of virtual point files: SFD's pseudo points and VirConv's velodyne_depth, one frame at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from auglidar_base.array_files import ArrayFileError, npy_array
from pipeline.base.errors import DataError
from pipeline.check.depths import check_depth, read_map
from pipeline.check.faults import Finding
from pipeline.check.frames import Place
from pipeline.data.frame import Frame
from pipeline.export.virconv import COLOUR_SCALE, MEASURED, VIRTUAL
from pipeline.geometry.calibration import Calibration
from pipeline.geometry.project import project_points

SFD_ROW = 36
# Mean colour difference in grey levels: 0 for points coloured from this image (float16 and a third: up to 1.5).
_SAME_COLOUR = 8.0
_OFFSET_PIXELS = 1.5


@dataclass(frozen=True)
class Pseudo:
    """Virtual points of a frame: xyz (N, 3), colours (N, 3) in 0..255, and their pixels (N,) u and v."""

    xyz: NDArray[np.float64]
    colour: NDArray[np.float64]
    u: NDArray[np.float64]
    v: NDArray[np.float64]


def examine_sfd(open_frame: Callable[[str], Frame], folder: Path, place: Place, name: str) -> list[Finding]:
    """Faults of one frame's depth_dense_twise and depth_pseudo_rgbseguv_twise files."""
    frame = open_frame(place.frame)
    findings: list[Finding] = []
    depth_path = folder / "depth_dense_twise" / f"{name}.png"
    if depth_path.is_file():
        depth, findings = read_map(depth_path, name)
        if depth is not None:
            findings = _judge_depth(depth, frame, place, open_frame, name, str(depth_path))
    path = folder / "depth_pseudo_rgbseguv_twise" / f"{name}.bin"
    if not path.is_file():
        return findings
    data = path.read_bytes()
    if not data:
        return [*findings, Finding("empty_file", name, str(path), "0 bytes")]
    if len(data) % SFD_ROW:
        message = f"{len(data)} bytes are not rows of 9 float32 (x y z r g b seg u v)"
        return [*findings, Finding("wrong_columns", name, str(path), message)]
    rows = np.frombuffer(data, dtype="<f4").reshape(-1, 9).astype(np.float64)
    return findings + _examine_sfd_rows(rows, frame, place, open_frame, name, str(path))


def _examine_sfd_rows(
    rows: NDArray[np.float64], frame: Frame, place: Place, open_frame: Callable[[str], Frame], name: str, where: str
) -> list[Finding]:
    if not np.isfinite(rows).all():
        bad = int((~np.isfinite(rows)).any(axis=1).sum())
        return [Finding("non_finite_points", name, where, f"{bad} of {len(rows)} rows hold NaN or infinite values")]
    wild = np.abs(rows[:, :3]).max(initial=0) > 1e4 or rows[:, 7:].min(initial=0) < -1000 or np.any(rows[:, 3:6] < 0)
    if wild:
        return [Finding("wrong_columns", name, where, "columns are not x y z r g b seg u v in float32")]
    largest = float(rows[:, 3:6].max(initial=0))
    if len(rows) > 100 and not 1.5 < largest < 255.5:
        return [Finding("colour_scale", name, where, f"colours reach {largest:.3g}, expected 0..255")]
    points = Pseudo(rows[:, :3], rows[:, 3:6], rows[:, 7], rows[:, 8])
    return _judge_pixels(points, frame, name, where) or _judge_colours(points, frame, place, open_frame, name, where)


def _judge_pixels(points: Pseudo, frame: Frame, name: str, where: str) -> list[Finding]:
    """u, v must be where x y z project in the full image."""
    if not len(points.u) or not frame.has("calibration"):
        return []
    pixels, _ = frame.calibration.cam_to_image(frame.calibration.velo_to_cam(points.xyz))
    du, dv = points.u - pixels[:, 0], points.v - pixels[:, 1]
    middle = np.array([np.median(du), np.median(dv)])
    scatter = float(np.median(np.hypot(du - middle[0], dv - middle[1])))
    if np.abs(middle).max() <= _OFFSET_PIXELS and scatter <= _OFFSET_PIXELS:
        return []
    if scatter <= _OFFSET_PIXELS:
        message = f"u, v lie {middle[0]:+.1f}, {middle[1]:+.1f} px from where x y z project: pixels of a cropped image?"
        return [Finding("wrong_crop", name, where, message)]
    message = f"u, v scatter by {scatter:.0f} px round the projection of x y z: another calibration or frame"
    return [Finding("points_disagree_with_pixels", name, where, message)]


def _judge_colours(
    points: Pseudo, frame: Frame, place: Place, open_frame: Callable[[str], Frame], name: str, where: str
) -> list[Finding]:
    """Colours must be the image's at the points' pixels, in RGB order."""
    if len(points.u) < 100 or not frame.has("image"):
        return []
    difference, swapped = _colour_difference(points, frame.image)
    if difference < _SAME_COLOUR:
        return []
    if swapped < min(_SAME_COLOUR, 0.5 * difference):
        message = f"colours differ from the image by {difference:.0f} grey levels, in BGR order by {swapped:.1f}"
        return [Finding("rgb_bgr_swap", name, where, message)]
    for other in place.neighbours:
        try:
            near, _ = _colour_difference(points, open_frame(other).image)
        except DataError:
            continue
        if near < _SAME_COLOUR:
            return [Finding("index_offset", name, where, f"colours are those of frame {other}'s image")]
    message = f"colours differ from the image by {difference:.0f} grey levels"
    return [Finding("points_disagree_with_pixels", name, where, message)]


def _colour_difference(points: Pseudo, image: NDArray[np.uint8]) -> tuple[float, float]:
    """Median difference to the image's colours as they are, and with red and blue exchanged."""
    u = np.rint(points.u).astype(np.int64).clip(0, image.shape[1] - 1)
    v = np.rint(points.v).astype(np.int64).clip(0, image.shape[0] - 1)
    colour = image[v, u].astype(np.float64)
    direct = np.abs(points.colour - colour).mean(axis=1)
    exchanged = np.abs(points.colour - colour[:, ::-1]).mean(axis=1)
    return float(direct.mean()), float(exchanged.mean())


def _judge_depth(
    depth: NDArray[np.float32], frame: Frame, place: Place, open_frame: Callable[[str], Frame], name: str, where: str
) -> list[Finding]:
    if not (frame.has("points") and frame.has("calibration") and frame.has("image_size")):
        return []
    near = [(other, partial(lidar_map, open_frame, other)) for other in place.neighbours]
    return check_depth(depth, frame.sparse_depth, frame.calibration, name, where, near)


def lidar_map(open_frame: Callable[[str], Frame], frame_id: str) -> NDArray[np.float32] | None:
    """The LiDAR map of another frame, or None when it cannot be made."""
    try:
        frame = open_frame(frame_id)
        return project_points(frame.points, frame.calibration, frame.image_size)
    except DataError:
        return None


def examine_virconv(open_frame: Callable[[str], Frame], folder: Path, place: Place, name: str) -> list[Finding]:
    """Faults of one frame's velodyne_depth file."""
    path = folder / "velodyne_depth" / f"{name}.npy"
    if not path.is_file():
        return []
    rows, found = _read_virconv(path, name)
    if rows is None:
        return found
    frame = open_frame(place.frame)
    where = str(path)
    measured, virtual = rows[rows[:, 7] == MEASURED], rows[rows[:, 7] == VIRTUAL]
    found = _judge_virconv_values(measured, virtual, name, where)
    if found or not frame.has("calibration"):
        return found
    found = _judge_measured(measured, frame, place, open_frame, name, where)
    if found or len(virtual) < 100 or not frame.has("image_size"):
        return found
    depth = _virtual_map(virtual, frame.calibration, frame.image_size)
    found = _judge_depth(depth, frame, place, open_frame, name, where)
    if found:
        return found
    pixels, _ = frame.calibration.cam_to_image(frame.calibration.velo_to_cam(virtual))
    points = Pseudo(virtual[:, :3], virtual[:, 4:7] * COLOUR_SCALE, pixels[:, 0], pixels[:, 1])
    return _judge_colours(points, frame, place, open_frame, name, where)


def _read_virconv(path: Path, name: str) -> tuple[NDArray[np.float64] | None, list[Finding]]:
    data = path.read_bytes()
    if not data:
        return None, [Finding("empty_file", name, str(path), "0 bytes")]
    try:
        rows = npy_array(data)
    except ArrayFileError as error:
        return None, [Finding("truncated_file", name, str(path), f"not a whole .npy array: {error}")]
    if rows.ndim != 2 or rows.shape[1] != 8 or rows.dtype not in (np.float16, np.float32):
        message = f"array {rows.shape} {rows.dtype}, expected (N, 8) float16 (or float32)"
        return None, [Finding("wrong_columns", name, str(path), message)]
    values = rows.astype(np.float64)
    if not np.isfinite(values).all():
        return None, [Finding("non_finite_points", name, str(path), "NaN or infinite values")]
    if not np.isin(values[:, 7], (VIRTUAL, MEASURED)).all():
        return None, [Finding("wrong_columns", name, str(path), "column 8 holds more than the flags 1 and 2")]
    return values, []


def _judge_virconv_values(
    measured: NDArray[np.float64], virtual: NDArray[np.float64], name: str, where: str
) -> list[Finding]:
    """Flags, intensity and colour scales."""
    if len(measured) and measured[:, 4:7].any() and not virtual[:, 4:7].any():
        return [Finding("source_flag_swapped", name, where, "rows with flag 2 (measured) hold colours")]
    brightest = float(measured[:, 3].max(initial=0))
    if len(measured) > 100 and not 1.5 < brightest < 15:
        message = f"measured intensity reaches {brightest:.3g}, expected about 10 (the loader divides by 10)"
        return [Finding("intensity_scale", name, where, message)]
    largest = float(virtual[:, 4:7].max(initial=0))
    if len(virtual) > 100 and not 1.5 < largest < 86:
        return [Finding("colour_scale", name, where, f"colours reach {largest:.3g}, expected 85 (a third of 255)")]
    return []


def _judge_measured(
    measured: NDArray[np.float64],
    frame: Frame,
    place: Place,
    open_frame: Callable[[str], Frame],
    name: str,
    where: str,
) -> list[Finding]:
    """The measured rows must be points of this frame's cloud."""
    if len(measured) < 100 or not frame.has("points"):
        return []
    if _share_of(measured, frame.points) > 0.5:
        return []
    for other in place.neighbours:
        try:
            share = _share_of(measured, open_frame(other).points)
        except DataError:
            continue
        if share > 0.5:
            return [Finding("index_offset", name, where, f"its measured rows are points of frame {other}")]
    return [
        Finding("points_disagree_with_pixels", name, where, "its measured rows are not points of this frame's cloud")
    ]


def _share_of(rows: NDArray[np.float64], points: NDArray[np.float32]) -> float:
    """Share of the rows whose x y z, rounded to float16, are in a cloud rounded likewise."""
    known = {row.tobytes() for row in np.ascontiguousarray(points[:, :3]).astype(np.float16)}
    sample = rows[:: max(len(rows) // 500, 1), :3].astype(np.float16)
    return sum(row.tobytes() in known for row in np.ascontiguousarray(sample)) / len(sample)


def _virtual_map(virtual: NDArray[np.float64], calibration: Calibration, size: tuple[int, int]) -> NDArray[np.float32]:
    """The virtual points as a depth map, with neighbours filled in since only one point per cell is left."""
    import cv2

    sparse = project_points(virtual[:, :3], calibration, size)
    inverse = np.divide(1, sparse, out=np.zeros_like(sparse), where=sparse > 0)
    near = cv2.dilate(inverse, np.ones((3, 3), np.uint8))
    filled = np.where(sparse > 0, sparse, np.divide(1, near, out=np.zeros_like(near), where=near > 0))
    return np.asarray(filled, dtype=np.float32)
