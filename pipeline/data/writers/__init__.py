"""Writers of synthetic data in the layouts of public data sets: KITTI object, KITTI depth, Virtual KITTI 2."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.simulation.synth import SynthSettings


def plan(settings: SynthSettings) -> list[int]:
    """The independent jobs of a data set: frames (KITTI object), drives (KITTI depth) or scenes (Virtual KITTI 2)."""
    from pipeline.data.writers.kitti_depth import drives
    from pipeline.data.writers.vkitti2 import scene_lengths

    if settings.layout == "kitti_depth":
        return list(range(len(drives(settings.frames))))
    if settings.layout == "vkitti2":
        return list(range(len(scene_lengths(settings.frames))))
    return list(range(settings.frames))


def write_job(root: Path, settings: SynthSettings, job: int) -> None:
    """Simulates and writes one job."""
    from pipeline.data.writers.kitti_depth import write_drive
    from pipeline.data.writers.kitti_object import write_kitti_frame
    from pipeline.data.writers.vkitti2 import write_scene
    from pipeline.simulation.synth import simulate_frame

    if settings.layout == "kitti_depth":
        write_drive(root, settings, job)
    elif settings.layout == "vkitti2":
        write_scene(root, settings, job)
    else:
        write_kitti_frame(root, simulate_frame(settings, job))


def finish(root: Path, settings: SynthSettings) -> None:
    """Writes what belongs to the data set as a whole."""
    from pipeline.data.writers.kitti_depth import write_day_calibration
    from pipeline.data.writers.kitti_object import write_splits
    from pipeline.simulation.sequence import sequence_rig

    if settings.layout == "kitti":
        write_splits(root, [f"{index:06d}" for index in range(settings.frames)])
    elif settings.layout == "kitti_depth":
        calibration, size = sequence_rig(settings)
        write_day_calibration(root, calibration, size)
