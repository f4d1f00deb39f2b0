"""A data set: an ordered list of frame ids and a way to open one of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path

from detection.evaluation.reading import renamed_like
from pipeline.base.errors import DataError, UsageError
from pipeline.base.files import read_text
from pipeline.data.frame import Frame


@dataclass(frozen=True, eq=False)
class Dataset:
    """Frames of one data set, opened one at a time.

    ids    frame ids in the order of iteration
    open   id -> Frame; nothing of the frame is read until one of its parts is asked for
    name   data set name ("kitti_object", ...)
    root   folder, named in messages
    notes    what was taken although it is not written as the layout has it, one line a kind
    strays   files that look like a part of a frame but belong to none
    refusal  why no frame can be read as it is, or nothing: the line with which a run ends before it begins

    A plain value: it travels to worker processes when `open` does (readers use functools.partial of a module function).
    """

    ids: tuple[str, ...]
    open: Callable[[str], Frame] = field(repr=False)
    name: str = ""
    root: str = ""
    notes: tuple[str, ...] = ()
    strays: tuple[Path, ...] = ()
    refusal: str = ""
    _known: frozenset[str] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "ids", tuple(self.ids))
        object.__setattr__(self, "_known", frozenset(self.ids))
        if len(self._known) != len(self.ids):
            raise DataError(self.root or self.name, "every frame id once", "repeated frame ids")

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, key: str | int) -> Frame:
        """The frame with this id, or the frame at this position. Raises DataError for an unknown id."""
        if not isinstance(key, str):
            return self.open(self.ids[key])
        if key not in self._known:
            near = ", ".join(self.ids[:3]) + (", ..." if len(self.ids) > 3 else "")
            raise DataError(self.root or self.name, f"one of {len(self.ids)} frames ({near or 'none'})", key)
        return self.open(key)

    def __iter__(self) -> Iterator[Frame]:
        return (self.open(frame_id) for frame_id in self.ids)

    def __contains__(self, frame_id: object) -> bool:
        return frame_id in self._known

    def select(self, frames: str | Path | range | slice | Iterable[str]) -> Dataset:
        """The same data set with fewer frames.

        frames  "a:b" (positions, b excluded, either may be left out), range or slice of positions, a split file
                (one id a line, blank lines and lines starting with '#' skipped), a comma-separated list or ids;
                an entry with * or ? is a pattern ("Scene20/clone/*")
        Raises UsageError when a frame is not in the data set or a split file does not exist.
        """
        wanted = self._positions(frames)
        if wanted is None:
            named = [name for entry in _names(frames) for name in self._matching(entry)]  # type: ignore[arg-type]
            # 1, 001 and 000001 are the same frame, as everywhere.
            wanted = tuple(renamed_like(named, self.ids).get(name, name) for name in named)
        missing = [frame_id for frame_id in wanted if frame_id not in self._known]
        if missing:
            shown = ", ".join(missing[:5]) + (", ..." if len(missing) > 5 else "")
            raise UsageError(
                f"{len(missing)} of {len(wanted)} frames asked for are not in {self.root or self.name}: {shown}"
            )
        return replace(self, ids=wanted)

    def _matching(self, entry: str) -> list[str]:
        """The ids of a pattern, or the entry itself when it is not one."""
        if not any(sign in entry for sign in "*?"):
            return [entry]
        return [frame_id for frame_id in self.ids if fnmatchcase(frame_id, entry)] or [entry]

    def _positions(self, frames: object) -> tuple[str, ...] | None:
        """Ids at a range or slice of positions, or None when `frames` is neither."""
        if isinstance(frames, slice):
            return self.ids[frames]
        if isinstance(frames, range):
            beyond = [i for i in frames if not 0 <= i < len(self.ids)]
            if beyond:
                raise UsageError(
                    f"position {beyond[0]} is outside the {len(self.ids)} frames of {self.root or self.name}"
                )
            return tuple(self.ids[i] for i in frames)
        if isinstance(frames, str):
            start, colon, stop = frames.partition(":")
            if colon and all(part == "" or _is_position(part) for part in (start, stop)):
                return self.ids[slice(int(start) if start else None, int(stop) if stop else None)]
        return None


def _is_position(text: str) -> bool:
    return len(text) < 19 and text.removeprefix("-").isdecimal()


def _names(frames: str | Path | Iterable[str]) -> list[str]:
    """Ids of a split file, a comma-separated list or an iterable."""
    if isinstance(frames, str) and frames and not Path(frames).is_file() and not frames.endswith(".txt"):
        return [part.strip() for part in frames.split(",") if part.strip()]
    if isinstance(frames, (str, Path)):
        return read_split(Path(frames))
    return [str(frame_id) for frame_id in frames]


def read_split(path: Path) -> list[str]:
    """Frame ids of a split file: one a line, blank lines and lines starting with '#' skipped."""
    if not path.exists():
        raise UsageError(f"split file not found: {path} (one frame id a line)")
    lines = read_text(path, "a split file (one frame id a line)").splitlines()
    return [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
