"""The work itself, one frame at a time; an object of this kind lives in every worker process."""

from __future__ import annotations

import time
from pathlib import Path

from pipeline.base.errors import DataError, UsageError
from pipeline.base.files import check_inside
from pipeline.base.paths import RunFolder
from pipeline.data import Frame
from pipeline.run_folder.config import Config
from pipeline.run_folder.frames import data_root, open_frames
from pipeline.runner.jobs import Outcome, Task, outcome_of_error
from pipeline.runner.limits import bounded_memory, check_size
from pipeline.stages.order import FRAME_STAGES
from pipeline.stages.stage import FrameStage, Work


class FrameWorker:
    """Does tasks of one run. Networks are loaded at the first task of a stage and dropped at the next stage's."""

    def __init__(self, config: Config, out: Path) -> None:
        self.config, self.run_folder = config, RunFolder(out)
        self.dataset = open_frames(config, self.run_folder)
        self._stage: tuple[str, FrameStage, Work] | None = None

    def do(self, task: Task) -> Outcome:
        """The outcome of a task; errors become part of it, whatever they are, so that other frames go on."""
        try:
            stage, work = self._opened(task.stage)
        except (UsageError, DataError, OSError, ValueError) as error:
            return Outcome(task, refused=str(error))
        start = time.perf_counter()
        try:
            files = stage.declared_files(self.run_folder, task.frame)
            frame = self.dataset[task.frame]
            self._check_files(stage, frame)
            with bounded_memory(self.config.limits.memory_gb):
                work(stage.declared_frame(frame), files)
        except Exception as error:
            return outcome_of_error(task, error, time.perf_counter() - start)
        return Outcome(task, files.written, time.perf_counter() - start)

    def _check_files(self, stage: FrameStage, frame: Frame) -> None:
        """Refuses files beyond `limits.file_mb`, and links: a data set from elsewhere must not read other files."""
        root = data_root(self.config, self.run_folder)
        for part in stage.parts(frame):
            for path in frame.files(part):
                check_inside(path, root)
                check_size(path, self.config.limits.file_mb)

    def _opened(self, name: str) -> tuple[FrameStage, Work]:
        if self._stage is None or self._stage[0] != name:
            self._stage = None
            stage = FRAME_STAGES[name].of(self.config)
            self._stage = (name, stage, stage.open())
        return self._stage[1:]
