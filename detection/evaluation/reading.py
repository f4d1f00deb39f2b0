"""Label and result folders as tables: fast when all is well, exact about file and line when something is not."""

from __future__ import annotations

import math
import os
from array import array
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from detection.evaluation.objects import FrameObjects, ObjectTable, build_table, named_frames, table_of
from detection.kitti_format import parse_line

MISSING = ("error", "skip", "empty")
BROKEN_LINE = "broken line"

PathLike = str | os.PathLike[str]


class InputError(ValueError):
    """Labels or detections that cannot be evaluated: what was expected, what came, which file, what to do."""


@dataclass
class Problems:
    """What a lenient reading passed over: (kind, message) in the order found."""

    lenient: bool
    found: list[tuple[str, str]] = field(default_factory=list)

    def report(self, kind: str, message: str) -> None:
        """Keep the problem when lenient; raise InputError otherwise."""
        if not self.lenient:
            raise InputError(message)
        self.found.append((kind, message))

    def counts(self) -> dict[str, int]:
        """Kind -> how many were passed over."""
        return dict(Counter(kind for kind, _ in self.found))


@dataclass(frozen=True)
class FramePair:
    """Labels and detections of the same frames in the same order, and what was passed over while reading them."""

    labels: ObjectTable
    detections: ObjectTable
    problems: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        if self.labels.frames != self.detections.frames:
            raise InputError("labels and detections hold different frames")

    @property
    def frames(self) -> tuple[str, ...]:
        """Frame names in the order of evaluation."""
        return self.labels.frames


def read_split(path: PathLike) -> list[str]:
    """Frame names of a split file, one per line; blank lines are skipped. Raises InputError on doubles or none."""
    try:
        names = Path(path).read_text(encoding="utf-8").split()
    except OSError as error:
        raise InputError(f"split file {path}: {error.strerror or error}") from None
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError(f"{path}: frame {twice[0]} is listed twice ({len(twice)} such frames)")
    if not names:
        raise InputError(f"{path}: expected one frame name per line, the file is empty")
    return names


def result_folder(folder: PathLike, what: str) -> Path:
    """The folder that holds the .txt files: `folder` itself or its data/ (official devkit). Raises InputError."""
    path = Path(folder)
    if not path.is_dir():
        raise InputError(f"{what}: no such folder: {path}")
    for candidate in (path, path / "data"):
        if candidate.is_dir() and any(name.endswith(".txt") for name in os.listdir(candidate)):
            return candidate
    if what == "labels":
        hint = "the test split has no public labels: evaluate a split that has (val), or pass its label_2 folder"
    else:
        hint = "expected one result file per frame, named like the label files (000000.txt)"
    raise InputError(f"{what}: no .txt files in {path}; {hint}")


def frame_names(folder: Path) -> list[str]:
    """Names of the .txt files of a folder without the suffix, sorted."""
    return sorted(name[:-4] for name in os.listdir(folder) if name.endswith(".txt"))


def read_pair(
    labels: PathLike | FrameObjects,
    detections: PathLike | FrameObjects,
    *,
    frames: Sequence[str] | None = None,
    missing: str = "error",
    lenient: bool = False,
) -> FramePair:
    """Labels and detections of the frames to evaluate, from folders or from objects in memory.

    frames   names to evaluate in this order (a split); None = every labelled frame
    missing  a frame without a result file: "error", "skip" (leave the frame out, as the official offline tool does:
             recall is then over-estimated) or "empty" (count it as a frame without detections)
    lenient  pass over broken lines, missing files and results of unknown frames, and count them
    Raises InputError naming file and line.
    """
    if missing not in MISSING:
        raise InputError(f"missing: expected one of {', '.join(MISSING)}, got {missing!r}")
    problems = Problems(lenient)
    label_source = _source(labels, "labels")
    detection_source = _source(detections, "detections")
    wanted = list(frames) if frames is not None else label_source.names()
    chosen = _frames_to_evaluate(wanted, label_source, detection_source, frames is not None, missing, problems)
    return FramePair(
        label_source.table(chosen, problems), detection_source.table(chosen, problems), tuple(problems.found)
    )


@dataclass(frozen=True)
class _Folder:
    """Frames in a folder of text files."""

    path: Path
    scored: bool

    def names(self) -> list[str]:
        return frame_names(self.path)

    def __str__(self) -> str:
        return str(self.path)

    def table(self, frames: Sequence[str], problems: Problems) -> ObjectTable:
        return read_table(self.path, frames, scored=self.scored, problems=problems)


@dataclass(frozen=True)
class _Memory:
    """Frames in memory."""

    frames: FrameObjects
    scored: bool

    def names(self) -> list[str]:
        return list(named_frames(self.frames))

    def __str__(self) -> str:
        return "detections" if self.scored else "labels"

    def table(self, frames: Sequence[str], problems: Problems) -> ObjectTable:
        objects = named_frames(self.frames)
        return table_of(frames, (objects.get(name, ()) for name in frames), scored=self.scored)


def _source(given: PathLike | FrameObjects, what: str) -> _Folder | _Memory:
    scored = what == "detections"
    if isinstance(given, (str, os.PathLike)):
        return _Folder(result_folder(given, what), scored)
    return _Memory(given, scored)


def _frames_to_evaluate(
    wanted: list[str],
    labels: _Folder | _Memory,
    detections: _Folder | _Memory,
    from_split: bool,
    missing: str,
    problems: Problems,
) -> list[str]:
    """The frames of `wanted` that can be evaluated; reports unlabelled, missing and unknown ones."""
    labelled, detected = set(labels.names()), set(detections.names())
    unlabelled = [name for name in wanted if name not in labelled]
    if unlabelled:
        problems.report(
            "frame without label",
            f"{labels}: no label file for frame {unlabelled[0]} ({len(unlabelled)} of {len(wanted)} frames of the "
            "split); the test split has no public labels",
        )
    if not detected & labelled:
        raise InputError(
            f"no frame in common: labels are named {_span(labelled)}, detections {_span(detected)}; "
            "name result files like the label files and check that both belong to the same split"
        )
    # A split selects, so results of labelled frames outside it are no mistake; results nobody has a label for are.
    unknown = sorted(detected - labelled)
    if unknown:
        problems.report(
            "result of unknown frame",
            f"{detections}: result for unknown frame {unknown[0]} ({len(unknown)} such files); "
            "there is no label of that name",
        )
    known = [name for name in wanted if name in labelled]
    absent = [name for name in known if name not in detected]
    if absent and missing == "error":
        hint = "" if from_split else "; name the frames to evaluate with a split file"
        problems.report(
            "missing result file",
            f"{detections}: no result file for frame {absent[0]} ({len(absent)} of {len(known)} frames); write an "
            f"empty file where nothing was found{hint}, or pass missing=empty or missing=skip",
        )
    return [name for name in known if name in detected] if missing == "skip" else known


def _span(names: Iterable[str]) -> str:
    ordered = sorted(names)
    return f"{ordered[0]} to {ordered[-1]}" if ordered else "nothing"


def read_table(folder: Path, frames: Sequence[str], *, scored: bool, problems: Problems) -> ObjectTable:
    """The objects of FOLDER/FRAME.txt for every frame; a missing file counts as empty (see `read_pair`).

    Raises InputError (unless lenient) with file, line and column of the first broken line.
    """
    width = 15 if scored else 14
    counts, lines, names = [], [], []
    numbers = array("d")  # a list of Python floats would take four times the memory
    for frame in frames:
        path = os.path.join(folder, f"{frame}.txt")
        kept = 0
        for number, fields in _file_lines(path):
            try:
                numbers.extend(_numbers(fields, width, f"{path}:{number}", scored))
            except ValueError as error:
                problems.report(BROKEN_LINE, str(error))
                continue
            names.append(fields[0])
            lines.append(number)
            kept += 1
        counts.append(kept)
    values = np.full((len(names), 15), np.nan)
    values[:, :width] = np.asarray(numbers).reshape(-1, width)
    return build_table(frames, counts, names, values, lines)


def _file_lines(path: str) -> list[tuple[int, list[str]]]:
    """(line number, fields) of every line that is not blank; nothing for a file that is not there."""
    try:
        with open(path, "rb") as file:
            text = file.read().decode("utf-8", errors="replace")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    split = [line.split() for line in text.splitlines()]
    return [(number, fields) for number, fields in enumerate(split, start=1) if fields]


def _numbers(fields: list[str], width: int, where: str, scored: bool) -> list[float]:
    """The numbers after the type. Raises ValueError naming the column when count, text or value is wrong."""
    if len(fields) == width + 1:
        try:
            numbers = list(map(float, fields[1:]))
        except ValueError:
            numbers = [math.nan]
        # One sum is far cheaper than a test per number: it is finite only if all of them are.
        if math.isfinite(sum(numbers)):
            return numbers
    parse_line(" ".join(fields), where=where, scored=scored)
    return list(map(float, fields[1:]))
