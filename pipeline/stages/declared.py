"""A frame and its files narrowed to what a stage declares: reading anything else is an error, not a stale result."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from pipeline.data.frame import Frame
from pipeline.run_folder.frame_outputs import FrameOutputs


class UndeclaredError(RuntimeError):
    """A stage reads or writes what it does not declare: a fault of the program, which the runner shows as such."""


@dataclass(frozen=True, eq=False)
class DeclaredFrame(Frame):
    """A frame of which a stage sees the declared parts; also whether another part exists is none of its business."""

    declared: frozenset[str] = frozenset()

    @classmethod
    def of(cls, frame: Frame, parts: Iterable[str]) -> DeclaredFrame:
        """`frame` with these parts."""
        declared = frozenset(parts)
        # A stored part that is not declared stays as a refusal: nothing else is derived in its place.
        loaders = {
            part: loader if part in declared else partial(_refuse, part, declared)
            for part, loader in frame.loaders.items()
        }
        return cls(frame.id, loaders, frame.where, declared)

    def has(self, part: str) -> bool:
        """As `Frame.has`. Raises UndeclaredError for a part that is not declared."""
        self._require(part)
        return super().has(part)

    def files(self, part: str) -> tuple[Path, ...]:
        """As `Frame.files`. Raises UndeclaredError for a part that is not declared."""
        self._require(part)
        return super().files(part)

    def _load(self, part: str) -> Any:
        self._require(part)
        return super()._load(part)

    def _require(self, part: str) -> None:
        if part not in self.declared:
            _refuse(part, self.declared)


def _refuse(part: str, declared: frozenset[str]) -> NoReturn:
    raise UndeclaredError(f"the stage reads {part} of a frame, and declares {', '.join(sorted(declared))}")


@dataclass(frozen=True)
class DeclaredFiles(FrameOutputs):
    """The outputs of a frame of which a stage reads and writes the declared ones, by their names in `RunFolder`."""

    may_read: frozenset[str] = field(default=frozenset(), kw_only=True)
    may_write: frozenset[str] = field(default=frozenset(), kw_only=True)

    def to_read(self, name: str) -> Path:
        """As `FrameOutputs.to_read`. Raises UndeclaredError for a file that is not declared."""
        if name not in self.may_read:
            raise UndeclaredError(f"the stage reads {name} of the run, and declares {', '.join(sorted(self.may_read))}")
        return super().to_read(name)

    def to_write(self, name: str) -> Path:
        """As `FrameOutputs.to_write`. Raises UndeclaredError for a file that is not declared."""
        if name not in self.may_write:
            raise UndeclaredError(f"the stage writes {name}, and declares {', '.join(sorted(self.may_write))}")
        return super().to_write(name)
