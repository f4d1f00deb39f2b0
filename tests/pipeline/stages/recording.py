"""What a stage really does while it works: the files it opens and the settings it reads, beside what its key holds."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.base.paths import RunFolder
from pipeline.data.frame import Frame
from pipeline.run_folder.frame_outputs import content_hash
from pipeline.runner.keys import stage_key, task_key
from pipeline.stages.declared import UndeclaredError
from pipeline.stages.stage import FrameStage

ROOT = Path(__file__).resolve().parents[3]
_listening: list[set[Path]] = []


def _note(event: str, arguments: tuple[Any, ...]) -> None:
    """Audit hook: notes files opened for reading. Hooks stay for good; without a listener this one does nothing."""
    if event == "open" and _listening and not isinstance(arguments[0], int):
        path, mode, flags = arguments
        if mode in ("r", "rb") or (mode is None and flags & os.O_ACCMODE == os.O_RDONLY):
            _listening[-1].add(Path(os.fsdecode(path)).absolute())


sys.addaudithook(_note)


@contextmanager
def opened_files() -> Iterator[set[Path]]:
    """The files that Python opens for reading within the block, whoever opens them."""
    _listening.append(set())
    try:
        yield _listening[-1]
    finally:
        _listening.pop()


def is_input(path: Path, root: Path) -> bool:
    """True for data, masks and outputs, which lie under `root`, and for weights; not for source and caches."""
    return path.is_relative_to(root) or (path.is_relative_to(ROOT) and path.parent.name == "weights")


@dataclasses.dataclass(frozen=True)
class Recording:
    """Settings by name, and files, that the work of one frame used."""

    settings: frozenset[str]
    files: frozenset[Path]


def work(stage: FrameStage, frame: Frame, run: RunFolder) -> Recording:
    """Does what a worker does with a frame, and records it. Everything is opened anew."""
    names = {field.name for field in dataclasses.fields(stage)}
    read: set[str] = set()

    class Recorded(type(stage)):  # type: ignore[misc]
        def __getattribute__(self, name: str) -> Any:
            if name in names:
                read.add(name)
            return super().__getattribute__(name)

    recorded = Recorded(*(getattr(stage, field.name) for field in dataclasses.fields(stage)))
    declared_frame, declared_files = recorded.declared_frame(frame), recorded.declared_files(run, frame.id)
    read.clear()
    with opened_files() as files:
        recorded.open()(declared_frame, declared_files)
    root = run.root.parent.absolute()
    return Recording(frozenset(read), frozenset(path for path in files if is_input(path, root)))


def covered_files(stage: FrameStage, frame: Frame, run: RunFolder) -> set[Path]:
    """The files whose contents stand in the key."""
    of_frame = (path for part in stage.parts(frame) for path in frame.files(part))
    return {path.absolute() for path in (*of_frame, *stage.files(run, frame.id), *stage.weights())}


def uncovered(stage: FrameStage, frame: Frame, run: RunFolder) -> list[str]:
    """What the work uses and its key does not hold; the refusal when the stage is not even given it."""
    try:
        recording = work(stage, frame, run)
    except UndeclaredError as error:
        return [str(error)]
    taken_away = {run.output(name, frame.id).absolute() for name in stage.removes()}
    files = recording.files - covered_files(stage, frame, run) - taken_away
    return sorted([*(recording.settings - stage.settings().keys()), *map(str, files)])


def file_hash(path: Path) -> str:
    """The contents of a file, as the ledger hashes them."""
    return content_hash(path.read_bytes()) if path.is_file() else "absent"


def key(stage: FrameStage, frame: Frame, run: RunFolder) -> str:
    """The ledger key of a frame, as the runner makes it."""
    shared = stage_key(stage.settings(), stage.weights(), stage.code, file_hash)
    return task_key(shared, frame, stage.parts(frame), stage.files(run, frame.id), file_hash)
