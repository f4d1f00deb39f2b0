"""KITTI depth completion layout: short drives with sparse, semi-dense and dense depth.

ROOT/{data_depth_velodyne,data_depth_annotated}/{train,val}/DRIVE_sync/proj_depth/{velodyne_raw,groundtruth}/image_02,
raw drives in ROOT/DAY/DRIVE_sync/{image_02,image_03,velodyne_points}/data with the day's calibration, and, ours alone,
the exact depth in ROOT/data_depth_dense/{train,val}/DRIVE_sync/proj_depth/dense/image_02. As in KITTI the first and
last five frames of a drive have no ground truth.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from auglidar_base.atomic import write_bytes, write_text
from pipeline.data.depth_png import depth_png_bytes, png_bytes
from pipeline.geometry.calibration import Calibration
from pipeline.geometry.project import project_points

if TYPE_CHECKING:
    from pipeline.simulation.synth import SyntheticFrame, SynthSettings

# A date on which KITTI recorded nothing.
DAY = "2000_01_01"
FRAMES_PER_DRIVE = 20


def drives(frames: int) -> list[int]:
    """Frames with ground truth in each drive, so that all drives together have `frames`."""
    full, rest = divmod(frames, FRAMES_PER_DRIVE)
    return [FRAMES_PER_DRIVE] * full + ([rest] if rest else [])


def write_drive(root: Path, settings: SynthSettings, number: int) -> None:
    """Simulates and writes one drive; the scans of a window of eleven frames are in memory at a time."""
    from pipeline.simulation.semi_dense import HALF_WINDOW
    from pipeline.simulation.sequence import simulate_sequence

    length = drives(settings.frames)[number] + 2 * HALF_WINDOW
    window: list[SyntheticFrame] = []
    for frame in simulate_sequence(settings, number, length):
        _write_raw(root, frame, number)
        window = [*window, frame][-(2 * HALF_WINDOW + 1) :]
        if len(window) == 2 * HALF_WINDOW + 1:
            _write_depth(root, window, number, settings)


def drive_name(number: int) -> str:
    """Name of a drive's folder."""
    return f"{DAY}_drive_{number:04d}_sync"


def _write_raw(root: Path, frame: SyntheticFrame, number: int) -> None:
    drive = root / DAY / drive_name(number)
    write_bytes(drive / "image_02" / "data" / f"{frame.id}.png", png_bytes(frame.image))
    if frame.right is not None:
        write_bytes(drive / "image_03" / "data" / f"{frame.id}.png", png_bytes(frame.right.image))
    write_bytes(drive / "velodyne_points" / "data" / f"{frame.id}.bin", frame.points.astype("<f4").tobytes())


def _write_depth(root: Path, window: list[SyntheticFrame], number: int, settings: SynthSettings) -> None:
    """Sparse, semi-dense and dense depth of the middle frame of the window."""
    middle = window[len(window) // 2]
    maps = {
        ("data_depth_velodyne", "velodyne_raw"): project_points(middle.points, middle.calibration, middle.depth.shape),
        ("data_depth_annotated", "groundtruth"): pseudo_ground_truth(window, [settings.seed, number, int(middle.id)]),
        ("data_depth_dense", "dense"): np.minimum(middle.depth, 255.0),
    }
    split = "val" if number % 4 == 3 else "train"
    for (base, kind), depth in maps.items():
        folder = root / base / split / drive_name(number) / "proj_depth" / kind / "image_02"
        write_bytes(folder / f"{middle.id}.png", depth_png_bytes(depth))


def pseudo_ground_truth(window: list[SyntheticFrame], seed: list[int]) -> NDArray[np.float32]:
    """(H, W) semi-dense depth of the middle frame of a window of stereo frames. Raises ValueError without stereo."""
    from pipeline.simulation.semi_dense import semi_dense, stereo_depth

    centre = len(window) // 2
    middle = window[centre]
    if middle.right is None:
        raise ValueError(f"frame {middle.id}: expected a stereo pair, got the left image only")
    stereo = stereo_depth(middle.image, middle.right.image, float(middle.calibration.P2[0, 0]))
    poses = [np.asarray(frame.T_world_cam @ frame.calibration.T_cam_velo) for frame in window]
    rng = np.random.default_rng([*seed, 7])
    return semi_dense([frame.points for frame in window], poses, centre, stereo, middle.calibration, rng)


def write_day_calibration(root: Path, calibration: Calibration, size: tuple[int, int]) -> None:
    """calib_cam_to_cam.txt and calib_velo_to_cam.txt of the day."""

    def row(key: str, values: NDArray[np.float64]) -> str:
        return f"{key}: " + " ".join(f"{value:.12e}" for value in np.ravel(values)) + "\n"

    right = calibration.P2 if calibration.P3 is None else calibration.P3
    text = f"S_rect_02: {size[1]:.6e} {size[0]:.6e}\n" + row("R_rect_00", calibration.R0_rect)
    text += row("P_rect_02", calibration.P2) + row("P_rect_03", right)
    write_text(root / DAY / "calib_cam_to_cam.txt", text)
    T_cam0_velo = calibration.T_cam0_velo
    write_text(root / DAY / "calib_velo_to_cam.txt", row("R", T_cam0_velo[:3, :3]) + row("T", T_cam0_velo[:3, 3]))
