"""Writers of synthetic data in the layouts of public data sets: KITTI object, KITTI depth, Virtual KITTI 2."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.simulation.synth import SynthSettings


def plan(settings: SynthSettings) -> list[int]:
    """The independent jobs of a data set: frames (KITTI object), drives (KITTI depth) or scenes (Virtual KITTI 2)."""
    from pipeline.simulation.writers.kitti_depth import drives
    from pipeline.simulation.writers.vkitti2 import scene_lengths

    if settings.layout == "kitti_depth":
        return list(range(len(drives(settings.frames))))
    if settings.layout == "vkitti2":
        return list(range(len(scene_lengths(settings.frames))))
    return list(range(settings.frames))


def write_job(root: Path, settings: SynthSettings, job: int) -> None:
    """Simulates and writes one job."""
    from pipeline.simulation.synth import simulate_frame
    from pipeline.simulation.writers.kitti_depth import write_drive
    from pipeline.simulation.writers.kitti_object import write_kitti_frame
    from pipeline.simulation.writers.vkitti2 import write_scene

    if settings.layout == "kitti_depth":
        write_drive(root, settings, job)
    elif settings.layout == "vkitti2":
        write_scene(root, settings, job)
    else:
        write_kitti_frame(root, simulate_frame(settings, job))


def finish(root: Path, settings: SynthSettings) -> None:
    """Writes what belongs to the data set as a whole."""
    from pipeline.simulation.sequence import sequence_rig
    from pipeline.simulation.writers.kitti_depth import write_day_calibration
    from pipeline.simulation.writers.kitti_object import write_splits

    if settings.layout == "kitti":
        write_splits(root, [f"{index:06d}" for index in range(settings.frames)])
    elif settings.layout == "kitti_depth":
        calibration, size = sequence_rig(settings)
        write_day_calibration(root, calibration, size)


Progress = Callable[[int, int], None]


def write_dataset(root: Path, settings: SynthSettings, workers: int = 1, progress: Progress | None = None) -> Path:
    """Writes settings.frames frames below `root` in the layout asked for and returns `root`.

    workers   processes; 1 works in this one. The files do not depend on it, and a worker holds one frame at a time.
    progress  called with (frames done, frames in all) after each frame
    """
    root = Path(root)
    jobs = plan(settings)
    for done, _ in enumerate(_completed(root, settings, jobs, workers), start=1):
        if progress is not None:
            progress(done, len(jobs))
    finish(root, settings)
    return root


def _completed(root: Path, settings: SynthSettings, jobs: list[int], workers: int) -> Iterator[int]:
    """Runs the jobs and yields each as it is finished."""
    if workers <= 1:
        for job in jobs:
            yield _run(root, settings, job)
        return
    from concurrent.futures import as_completed

    from auglidar_base.children import process_pool

    with process_pool(workers, _one_thread) as pool:
        for future in as_completed([pool.submit(_run, root, settings, job) for job in jobs]):
            yield future.result()


def _one_thread() -> None:
    """Keeps a worker to one thread: the processes share the cores."""
    os.environ["OMP_NUM_THREADS"] = "1"
    import cv2

    cv2.setNumThreads(1)


def _run(root: Path, settings: SynthSettings, job: int) -> int:
    """One job of one worker: simulate and write."""
    write_job(root, settings, job)
    return job
