"""What a frame stage declares; the ledger key follows from the declaration, and the work gets nothing else."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pipeline.base.paths import RunFolder
from pipeline.base.settings import plain
from pipeline.data.frame import Frame
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.stages.declared import DeclaredFiles, DeclaredFrame

# Reads, calls and writes for one frame.
Work = Callable[[Frame, FrameOutputs], None]

# Source that decides what every stage reads and writes: frames, and the formats of the run folder.
FRAME_CODE = (
    "detection/boxes.py",
    "detection/kitti_format.py",
    "detection/text.py",
    "detection/types.py",
    "detection/evaluation/difficulty.py",
    "detection/evaluation/objects.py",
    "detection/evaluation/reading.py",
    "pipeline/stages",
    "pipeline/data",
    "pipeline/geometry",
    "pipeline/run_folder/frame_outputs.py",
)

# Modules that stages import and whose source is in no key, with the reason why no byte of a result can follow it.
NOT_IN_KEYS = {
    "pipeline/__init__.py": "holds the version alone",
    "pipeline/run_folder/config.py": "settles the settings; the values stand in the key",
    "pipeline/run_folder/preset.py": "settles the settings; the values stand in the key",
    "pipeline/run_folder/weights.py": "finds the weight files; their contents stand in the key",
    "pipeline/base/settings.py": "settles the settings; the values stand in the key",
    "pipeline/base/paths.py": "says where files lie, not what is in them",
    "pipeline/base/errors.py": "a frame that fails has no result",
    "pipeline/base/files.py": "gives the bytes of a file or fails",
    "auglidar_base/array_files.py": "gives the arrays of a file or fails",
    "auglidar_base/errors.py": "a frame that fails has no result",
    "auglidar_base/atomic.py": "a file is written whole or not at all",
}


@dataclass(frozen=True)
class FrameStage(ABC):
    """A stage that works on one frame at a time: one class in the file of its name.

    Its fields are its settings. `of` takes them from the configuration, and the work sees no other value of it; all of
    them stand in the key. Parts of the frame and files of the run that are not declared cannot be read (`declared.py`).

    code       package folders and files whose source decides the result
    seconds    wall time of one KITTI frame on one core, for --dry-run before anything was measured
    megabytes  size of what it writes for one KITTI frame
    """

    code: ClassVar[tuple[str, ...]]
    seconds: ClassVar[float]
    megabytes: ClassVar[float]

    @classmethod
    @abstractmethod
    def of(cls, config: Config) -> FrameStage:
        """The stage of a run. Raises UsageError for settings that cannot be used."""

    @abstractmethod
    def parts(self, frame: Frame) -> tuple[str, ...]:
        """The parts of the frame that are read (those a part is derived from: `Frame.sources`)."""

    def reads(self) -> tuple[str, ...]:
        """The outputs of earlier stages that are read, by their names in `RunFolder`."""
        return ()

    def user_files(self, frame_id: str) -> tuple[Path, ...]:
        """The files outside data set and run that are read for a frame."""
        return ()

    def weights(self) -> tuple[Path, ...]:
        """The weight files that are loaded. Raises UsageError when there are none of that name."""
        return ()

    @abstractmethod
    def writes(self) -> tuple[str, ...]:
        """The outputs, by their names in `RunFolder`."""

    def removes(self) -> tuple[str, ...]:
        """Files of the run that the stage takes away if they are there; they decide nothing."""
        return ()

    @abstractmethod
    def open(self) -> Work:
        """Loads networks and gives the function that does the work of a frame."""

    def settings(self) -> dict[str, Any]:
        """All settings as plain values, for the key."""
        values: dict[str, Any] = plain(self)
        return values

    def files(self, run: RunFolder, frame_id: str) -> tuple[Path, ...]:
        """Every file that is read for a frame beside the data set's."""
        return *(run.output(name, frame_id) for name in self.reads()), *self.user_files(frame_id)

    def declared_frame(self, frame: Frame) -> DeclaredFrame:
        """The frame as the work gets it: with the declared parts only."""
        return DeclaredFrame.of(frame, self.parts(frame))

    def declared_files(self, run: RunFolder, frame_id: str) -> DeclaredFiles:
        """The files of the run as the work gets them: the declared ones only."""
        removes = self.removes()
        may_read, may_write = frozenset((*self.reads(), *removes)), frozenset((*self.writes(), *removes))
        return DeclaredFiles(run, frame_id, may_read=may_read, may_write=may_write)
