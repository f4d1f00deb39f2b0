"""--dry-run: frames, files, gigabytes and minutes, from seconds measured earlier in this run or from defaults."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.runner.batch import Batch
from pipeline.runner.processes import available_cores
from pipeline.stages.order import FRAME_STAGES

_FILES_PER_FRAME = {"complete": 2, "augment": 2, "detect": 1}


@dataclass(frozen=True)
class StageEstimate:
    """What a stage would do: `measured` tells whether the seconds per frame come from this run's ledger."""

    stage: str
    frames: int
    files: int
    gigabytes: float
    minutes: float
    measured: bool


def estimate(stage: str, frames: int, workers: int, seconds_per_frame: float | None) -> StageEstimate:
    """The estimate for `frames` frames on `workers` processes (no more than there are cores count)."""
    kind = FRAME_STAGES[stage]
    seconds = kind.seconds if seconds_per_frame is None else seconds_per_frame
    parallel = max(1, min(workers, available_cores()))
    return StageEstimate(
        stage,
        frames,
        frames * _FILES_PER_FRAME[stage],
        frames * kind.megabytes / 1000,
        frames * seconds / parallel / 60,
        seconds_per_frame is not None,
    )


def estimate_batch(batch: Batch, stages: list[str], workers: int) -> list[StageEstimate]:
    """The estimates of a batch; frames that are up to date are left out, frames whose input will change are not."""
    estimates: list[StageEstimate] = []
    changing: set[str] = set()
    for stage in stages:
        shared = batch.shared_key(stage)
        for frame_id in batch.frames:
            if frame_id not in changing and not batch.is_up_to_date(
                stage, frame_id, batch.key(stage, frame_id, shared)
            ):
                changing.add(frame_id)
        estimates.append(estimate(stage, len(changing), workers, batch.ledger.mean_seconds(stage)))
    return estimates
