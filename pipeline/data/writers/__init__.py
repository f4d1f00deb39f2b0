"""Writers of synthetic data in the layouts of public data sets: KITTI object, KITTI depth, Virtual KITTI 2."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.simulation.synth import SynthSettings


def plan(settings: SynthSettings) -> list[int]:
    """The independent jobs of a data set: frames for KITTI object, sequences for the other layouts."""
    return list(range(settings.frames))


def write_job(root: Path, settings: SynthSettings, job: int) -> None:
    """Simulates and writes one job."""
    from pipeline.data.writers.kitti_object import write_kitti_frame
    from pipeline.simulation.synth import simulate_frame

    write_kitti_frame(root, simulate_frame(settings, job))


def finish(root: Path, settings: SynthSettings) -> None:
    """Writes what belongs to the data set as a whole."""
    from pipeline.data.writers.kitti_object import write_splits

    write_splits(root, [f"{index:06d}" for index in range(settings.frames)])
