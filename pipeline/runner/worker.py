"""The work itself, one frame at a time; an object of this kind lives in every worker process."""

from __future__ import annotations

import time
from pathlib import Path

from pipeline.base.errors import DataError, UsageError
from pipeline.base.files import check_inside
from pipeline.base.paths import RunFolder
from pipeline.data import Frame
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.frames import data_root, open_frames
from pipeline.runner.jobs import Outcome, Task, outcome_of_error
from pipeline.stages.order import FRAME_STAGES
from pipeline.stages.stage import FrameFunction


class FrameWorker:
    """Does tasks of one run. Networks are loaded at the first task of a stage and dropped at the next stage's."""

    def __init__(self, config: Config, out: Path) -> None:
        self.config, self.run_folder = config, RunFolder(out)
        self.dataset = open_frames(config, self.run_folder)
        self._stage: tuple[str, FrameFunction] | None = None

    def do(self, task: Task) -> Outcome:
        """The outcome of a task; errors become part of it, whatever they are, so that other frames go on."""
        try:
            process_frame = self._function(task.stage)
        except (UsageError, DataError, OSError, ValueError) as error:
            return Outcome(task, refused=str(error))
        start = time.perf_counter()
        files = FrameOutputs(self.run_folder, task.frame)
        try:
            frame = self.dataset[task.frame]
            self._check_links(task.stage, frame)
            process_frame(frame, files)
        except Exception as error:
            return outcome_of_error(task, error, time.perf_counter() - start)
        return Outcome(task, files.written, time.perf_counter() - start)

    def _check_links(self, stage: str, frame: Frame) -> None:
        """Refuses files that are links out of the data set; a data set from elsewhere must not read other files."""
        root = data_root(self.config, self.run_folder)
        for part in FRAME_STAGES[stage].parts(self.config, frame):
            for path in frame.files(part):
                check_inside(path, root)

    def _function(self, stage: str) -> FrameFunction:
        if self._stage is None or self._stage[0] != stage:
            self._stage = None
            self._stage = (stage, FRAME_STAGES[stage].prepare(self.config))
        return self._stage[1]
