"""What a frame stage says about itself, so that the runner redoes exactly what changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.base.paths import RunFolder
from pipeline.data import Frame
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs

FrameFunction = Callable[[Frame, FrameOutputs], None]


@dataclass(frozen=True)
class FrameStage:
    """A stage that works on one frame at a time.

    prepare   loads networks and gives the function that reads, calls and writes
    settings  everything of the configuration its result depends on
    parts     the parts of the frame it reads
    files     the files of earlier stages (or of the user) it reads for a frame
    weights   the weight files it loads
    code      package folders whose source decides the result
    seconds   wall time of one KITTI frame on one core, for --dry-run before anything was measured
    megabytes size of what it writes for one KITTI frame
    """

    prepare: Callable[[Config], FrameFunction]
    settings: Callable[[Config], Any]
    parts: Callable[[Config, Frame], tuple[str, ...]]
    files: Callable[[Config, RunFolder, str], tuple[Path, ...]]
    weights: Callable[[Config], tuple[Path, ...]]
    code: tuple[str, ...]
    seconds: float
    megabytes: float
