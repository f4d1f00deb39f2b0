"""Which files a folder has for which frames: one place decides, for runs, exports and the doctor alike.

A frame's file is called ID.SUFFIX. Suffixes in capitals are the same suffix, and names that differ only in leading
zeros (1, 001, 000001) are the same frame. What operating systems leave in folders (._x, Thumbs.db, @eaDir) is no data.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.data.dataset import Dataset


@dataclass(frozen=True)
class PartFiles:
    """The files of one part.

    folder    where they lie; it need not exist
    suffixes  of the files, the preferred one first, in small letters
    renamed   frame id -> file name, for files that are not called ID + suffix
    """

    folder: Path
    suffixes: tuple[str, ...]
    renamed: Mapping[str, str] = field(default_factory=dict, repr=False)

    def path(self, frame_id: str) -> Path:
        """The file of a frame; the preferred name when there is none."""
        if frame_id in self.renamed:
            return self.folder / self.renamed[frame_id]
        paths = [self.folder / f"{frame_id}{suffix}" for suffix in self.suffixes]
        return next((path for path in paths if path.is_file()), paths[0])

    def stems(self) -> dict[str, str]:
        """Name without suffix -> file name of every file of the part; the preferred suffix wins."""
        try:
            names = sorted(entry.name for entry in os.scandir(self.folder) if not entry.name.startswith("."))
        except (FileNotFoundError, NotADirectoryError):
            return {}
        found: dict[str, str] = {}
        for suffix in reversed(self.suffixes):
            found.update({os.path.splitext(n)[0]: n for n in names if os.path.splitext(n)[1].lower() == suffix})
        return found


@dataclass(frozen=True)
class FrameIndex:
    """The frames of a folder.

    ids     frame ids, sorted
    parts   part name -> its files
    strays  files that look like a part but belong to no frame
    """

    ids: tuple[str, ...]
    parts: Mapping[str, PartFiles]
    strays: tuple[Path, ...] = ()


def first_folder(root: Path, names: Sequence[str]) -> Path:
    """The first of the folders with a file in it; the first that exists, or the first name, without one."""
    folders = [root / name for name in names]
    filled = [f for f in folders if f.is_dir() and any(not name.startswith(".") for name in os.listdir(f))]
    there = [f for f in folders if f.is_dir()]
    return (filled or there or folders)[0]


def index_frames(parts: Mapping[str, PartFiles], makers: Sequence[str], fewest: int = 1) -> FrameIndex:
    """The frames that the files of `makers` make, and which file of every part is whose.

    fewest  a frame needs files of so many makers, where the folder has any frame that does; others are strays
    """
    stems = {part: files.stems() for part, files in parts.items()}
    canonical = _canonical_names([stems[part] for part in makers])
    counts: dict[str, int] = {}
    for part in makers:
        for frame in {canonical.get(_key(stem), stem) for stem in stems[part]}:
            counts[frame] = counts.get(frame, 0) + 1
    whole = {frame for frame, count in counts.items() if count >= fewest}
    frames = whole or set(counts)
    renamed: dict[str, dict[str, str]] = {part: {} for part in parts}
    strays = []
    for part, files in parts.items():
        for stem, name in stems[part].items():
            frame = stem if stem in frames else canonical.get(_key(stem), stem)
            if frame not in frames or (frame != stem and frame in stems[part]):
                strays.append(files.folder / name)
            elif name != f"{frame}{os.path.splitext(name)[1].lower()}":
                renamed[part][frame] = name
    indexed = {part: PartFiles(f.folder, f.suffixes, renamed[part]) for part, f in parts.items()}
    return FrameIndex(tuple(sorted(frames)), indexed, tuple(sorted(strays)))


def _key(stem: str) -> str | int:
    return int(stem) if stem.isascii() and stem.isdigit() else stem


def _canonical_names(folders: Iterable[Iterable[str]]) -> dict[str | int, str]:
    """Number -> the longest name it has in any folder; no name for numbers that one folder has twice."""
    names: dict[str | int, str] = {}
    twice: set[str | int] = set()
    for stems in folders:
        here: set[str | int] = set()
        for stem in stems:
            key = _key(stem)
            if key in here:
                twice.add(key)
            here.add(key)
            if len(stem) > len(names.get(key, "")):
                names[key] = stem
    return {key: name for key, name in names.items() if key not in twice}


def notes_of(index: FrameIndex, dataset: str) -> tuple[str, ...]:
    """What is worth a word about the names of a data set's files, one line a kind."""
    notes = [
        f"{files.folder}: {len(files.renamed)} files are named otherwise than their frames "
        f"({next(iter(files.renamed.values()))} is taken for frame {next(iter(files.renamed))})"
        for files in index.parts.values()
        if files.renamed
    ]
    if index.strays:
        shown = ", ".join(str(path) for path in index.strays[:3]) + (", ..." if len(index.strays) > 3 else "")
        notes.append(f"{dataset}: {len(index.strays)} files belong to no frame: {shown}")
    return tuple(notes)


def as_dataset(index: FrameIndex, dataset: Dataset) -> Dataset:
    """`dataset` with the notes and strays of its index."""
    from dataclasses import replace

    return replace(dataset, notes=(*dataset.notes, *notes_of(index, dataset.root)), strays=index.strays)
