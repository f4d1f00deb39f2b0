"""A batch: the frame stages of a run over its frames, with ledger, failures, budget and stop request."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Protocol

from pipeline.base.errors import DataError, UsageError
from pipeline.base.paths import RunFolder
from pipeline.base.progress import Counter, progress
from pipeline.data import Dataset
from pipeline.run_folder.config import Config
from pipeline.run_folder.frames import open_frames
from pipeline.runner.budget import DiskBudget
from pipeline.runner.jobs import Outcome, Task
from pipeline.runner.keys import stage_key, task_key
from pipeline.runner.ledger import Ledger, Row
from pipeline.runner.processes import LocalEngine, WorkerFactory, available_cores
from pipeline.runner.signals import StopRequest
from pipeline.runner.worker import FrameWorker
from pipeline.stages.order import FRAME_STAGES
from pipeline.stages.stage import FrameStage


class Engine(Protocol):
    """What a batch needs of an engine: local processes here, Ray elsewhere."""

    def outcomes(self, tasks: Iterator[Task], stopping: StopRequest) -> Iterator[Outcome]:
        """Outcomes of the tasks in any order; no new task is begun once `stopping()`."""

    def close(self) -> None:
        """Frees what the engine holds."""


@dataclass
class StageSummary:
    """What became of the frames of a stage; `seconds` is the work of the frames that were done now."""

    stage: str
    total: int
    done: int = 0
    up_to_date: int = 0
    failed: int = 0
    blocked: int = 0
    seconds: float = 0.0

    @property
    def left(self) -> int:
        """Frames that were not reached before a stop."""
        return self.total - self.done - self.up_to_date - self.failed - self.blocked


@dataclass
class Batch:
    """Runs stages over frames. Frames that fail in one stage are left out of the next ones."""

    config: Config
    run: RunFolder
    ledger: Ledger
    frames: tuple[str, ...]
    dataset: Dataset
    stop: StopRequest
    engine: Engine
    budget: DiskBudget
    failed: set[str] = field(default_factory=set)
    _stages: dict[str, FrameStage] = field(default_factory=dict, repr=False)

    def declared(self, stage: str) -> FrameStage:
        """The stage with the settings of this run."""
        if stage not in self._stages:
            self._stages[stage] = FRAME_STAGES[stage].of(self.config)
        return self._stages[stage]

    def run_stage(self, stage: str) -> StageSummary:
        """Every frame that is not up to date, through the engine and into the ledger."""
        summary = StageSummary(stage, len(self.frames))
        self.ledger.forget_failures(stage, self.frames)
        keys: dict[str, str] = {}
        with progress(stage, len(self.frames)) as counter:
            for outcome in self.engine.outcomes(self._pending(stage, keys, summary, counter), self.stop):
                if outcome.refused:
                    raise UsageError(outcome.refused)
                self.ledger.record(outcome, keys.pop(outcome.task.frame))
                self._account(outcome, summary, counter)
        return summary

    def _account(self, outcome: Outcome, summary: StageSummary, counter: Counter) -> None:
        counter.advance()
        self.budget.written_bytes += sum(file.size for file in outcome.written.values())
        if outcome.failure is None:
            summary.done += 1
            summary.seconds += outcome.seconds
            return
        summary.failed += 1
        self.failed.add(outcome.task.frame)
        counter.say(outcome.failure.line())
        if outcome.fatal:
            self.stop.ask(outcome.fatal)
        elif not self.config.run.keep_going:
            self.stop.ask("stopped at the first failure (run.keep_going is false)")

    def _pending(self, stage: str, keys: dict[str, str], summary: StageSummary, counter: Counter) -> Iterator[Task]:
        """The tasks still to do, found one by one as the engine asks for them; their keys are put into `keys`."""
        shared = self.shared_key(stage)
        for frame_id in self.frames:
            if frame_id in self.failed:
                summary.blocked += 1
                continue
            key = self.key(stage, frame_id, shared)
            if self.is_up_to_date(stage, frame_id, key):
                summary.up_to_date += 1
                counter.advance()
                continue
            reason = self.budget.exceeded()
            if reason:
                self.stop.ask(reason)
                return
            keys[frame_id] = key
            yield Task(stage, frame_id)

    def close(self) -> None:
        """Ends the workers and closes the ledger."""
        self.engine.close()
        self.ledger.close()

    def shared_key(self, stage: str) -> str:
        """The part of the key that all frames of a stage share."""
        declared = self.declared(stage)
        return stage_key(declared.settings(), declared.weights(), declared.code, self.ledger.file_hash)

    def key(self, stage: str, frame_id: str, shared: str) -> str:
        """The key of a task; a frame that cannot even be opened gets one that never matches."""
        declared = self.declared(stage)
        try:
            frame = self.dataset[frame_id]
            files = declared.files(self.run, frame_id)
            return task_key(shared, frame, declared.parts(frame), files, self.ledger.file_hash)
        except (DataError, OSError, UsageError) as error:
            return f"cannot be opened: {error}"

    def is_up_to_date(self, stage: str, frame_id: str, key: str) -> bool:
        """True when the task was finished with this key and its files are still what they were."""
        row = self.ledger.row(stage, frame_id)
        return row is not None and row.key == key and self._is_intact(row)

    def _is_intact(self, row: Row) -> bool:
        files = ((self.run.root / name, written) for name, written in row.written.items())
        return all(
            _has_size(path, written.size) and self.ledger.file_hash(path) == written.hash for path, written in files
        )


def _has_size(path: Path, size: int) -> bool:
    try:
        return path.stat().st_size == size
    except OSError:
        return False


def make_engine(name: str, worker: WorkerFactory, workers: int, frames: int) -> Engine:
    """The engine of this name with no more than one worker per frame; workers = 0 is one per core."""
    if name == "ray":
        from pipeline.runner.ray_engine import RayEngine

        return RayEngine(worker, min(workers, frames))
    return LocalEngine(worker, min(workers or available_cores(), max(frames, 1)))


def shard_of(frames: Sequence[str], shard: tuple[int, int] | None) -> tuple[str, ...]:
    """Every n-th frame from the i-th: shard (i, n) of the frames; all of them without a shard."""
    return tuple(frames) if shard is None else tuple(frames[shard[0] :: shard[1]])


def open_batch(
    config: Config,
    run: RunFolder,
    shard: tuple[int, int] | None,
    stop: StopRequest,
    engine: str = "local",
    verify: bool = False,
) -> Batch:
    """A batch over the frames of the configuration. UsageError when it cannot be set up.

    engine  local or ray
    verify  every input and output is read and hashed again, whatever the ledger remembers of it
    """
    dataset = open_frames(config, run)
    frames = shard_of(dataset.ids, shard)
    own = run.ledger(shard)
    ledger = Ledger(own, run.ledgers(), trust=not verify)
    worker = partial(FrameWorker, config, run.root)
    budget = DiskBudget(run.root, config.run.keep_free_gb, config.run.max_gb)
    return Batch(
        config, run, ledger, frames, dataset, stop, make_engine(engine, worker, config.run.workers, len(frames)), budget
    )
