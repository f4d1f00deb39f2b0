"""--dry-run: frames, files, gigabytes and minutes, from seconds measured earlier in this run or from defaults."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.run_folder.config import Config
from pipeline.runner.batch import Batch
from pipeline.runner.processes import available_cores
from pipeline.stages.order import FRAME_STAGES
from pipeline.stages.stage import FrameStage


@dataclass(frozen=True)
class StageEstimate:
    """What a stage would do: `measured` tells whether the seconds per frame come from this run's ledger."""

    stage: str
    frames: int
    files: int
    gigabytes: float
    minutes: float
    measured: bool


def estimate(name: str, stage: FrameStage, frames: int, workers: int, seconds_per_frame: float | None) -> StageEstimate:
    """The estimate for `frames` frames on `workers` processes (no more than there are cores count)."""
    seconds = stage.seconds if seconds_per_frame is None else seconds_per_frame
    parallel = max(1, min(workers, available_cores()))
    return StageEstimate(
        name,
        frames,
        frames * len(stage.writes()),
        frames * stage.megabytes / 1000,
        frames * seconds / parallel / 60,
        seconds_per_frame is not None,
    )


def unmeasured(config: Config, stages: list[str], frames: int, workers: int) -> list[StageEstimate]:
    """The estimates before anything was done: all frames, default seconds."""
    return [estimate(name, FRAME_STAGES[name].of(config), frames, workers, None) for name in stages]


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
        estimates.append(
            estimate(stage, batch.declared(stage), len(changing), workers, batch.ledger.mean_seconds(stage))
        )
    return estimates
