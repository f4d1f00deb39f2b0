"""Label and result folders as tables: fast when all is well, exact about file and line when something is not."""

from __future__ import annotations

import math
import os
from array import array
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from detection.evaluation.objects import FrameObjects, ObjectTable, build_table, named_frames, table_of
from detection.kitti_format import parse_line
from detection.text import decode_text, split_fields

MISSING = ("error", "skip", "empty")
BROKEN_LINE = "broken line"

PathLike = str | os.PathLike[str]


class InputError(ValueError):
    """Labels or detections that cannot be evaluated: what was expected, what came, which file, what to do."""


@dataclass
class Problems:
    """What a lenient reading passed over, (kind, message) in the order found; and what is worth a word though sound."""

    lenient: bool
    found: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

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
    """Labels and detections of the same frames in the same order, and what was passed over while reading them.

    problems  (kind, message) of what a lenient reading left out
    notes     what was read although it is not written as the devkit has it
    """

    labels: ObjectTable
    detections: ObjectTable
    problems: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()

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
        names = decode_text(Path(path).read_bytes()).split()
    except OSError as error:
        raise InputError(f"split file {path}: {error.strerror or error}") from None
    except ValueError as error:
        raise InputError(f"split file {path}: {error}") from None
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
        if candidate.is_dir() and _text_files(candidate):
            return candidate
    if what == "labels":
        hint = "the test split has no public labels: evaluate a split that has (val), or pass its label_2 folder"
    else:
        hint = "expected one result file per frame, named like the label files (000000.txt)"
    raise InputError(f"{what}: no .txt files in {path}; {hint}")


def frame_names(folder: Path) -> list[str]:
    """Names of the .txt files of a folder without the suffix, sorted."""
    return sorted(stem for stem, name in _text_files(folder).items() if name.endswith(".txt"))


def _text_files(folder: Path) -> dict[str, str]:
    """Frame name -> file name; files that systems leave behind (._000000.txt) belong to no frame."""
    names = (name for name in os.listdir(folder) if name.lower().endswith(".txt") and not name.startswith("."))
    return {name[:-4]: name for name in names}


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
    # 1.txt and 000001.txt are the same frame.
    label_names = label_source.names()
    detection_source = detection_source.named_like(label_names)
    wanted = label_names if frames is None else list(renamed_like(frames, label_names))
    chosen = _frames_to_evaluate(wanted, label_source, detection_source, frames is not None, missing, problems)
    return FramePair(
        label_source.table(chosen, problems),
        detection_source.table(chosen, problems),
        tuple(problems.found),
        tuple(problems.notes),
    )


def renamed_like(names: Iterable[str], known: Sequence[str]) -> dict[str, str]:
    """Name -> the known name of the same frame: itself, or the only known one of the same number (1, 001, 000001).

    Two names of one frame keep their own: 1 beside 000001 is a frame that nobody knows.
    """
    names = list(names)
    numbers: dict[int, str | None] = {}
    for name in filter(_is_number, known):
        numbers[int(name)] = None if int(name) in numbers else name
    exact, taken = set(known), set(names)
    found = {}
    for name in names:
        same = numbers.get(int(name)) if _is_number(name) and name not in exact else None
        found[name] = same if same is not None and same not in taken else name
        taken.add(found[name])
    return found


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdigit()


@dataclass(frozen=True)
class _Folder:
    """Frames in a folder of text files."""

    path: Path
    scored: bool
    files: Mapping[str, str]

    def names(self) -> list[str]:
        return sorted(self.files)

    def named_like(self, known: Sequence[str]) -> _Folder:
        called = renamed_like(self.files, known)
        return replace(self, files={called[name]: file for name, file in self.files.items()})

    def __str__(self) -> str:
        return str(self.path)

    def table(self, frames: Sequence[str], problems: Problems) -> ObjectTable:
        return read_table(self.path, frames, scored=self.scored, problems=problems, files=self.files)


@dataclass(frozen=True)
class _Memory:
    """Frames in memory."""

    frames: FrameObjects
    scored: bool

    def names(self) -> list[str]:
        return list(named_frames(self.frames))

    def named_like(self, known: Sequence[str]) -> _Memory:
        return self

    def __str__(self) -> str:
        return "detections" if self.scored else "labels"

    def table(self, frames: Sequence[str], problems: Problems) -> ObjectTable:
        objects = named_frames(self.frames)
        return table_of(frames, (objects.get(name, ()) for name in frames), scored=self.scored)


def _source(given: PathLike | FrameObjects, what: str) -> _Folder | _Memory:
    scored = what == "detections"
    if isinstance(given, (str, os.PathLike)):
        folder = result_folder(given, what)
        return _Folder(folder, scored, _text_files(folder))
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


def read_table(
    folder: Path,
    frames: Sequence[str],
    *,
    scored: bool,
    problems: Problems,
    files: Mapping[str, str] | None = None,
) -> ObjectTable:
    """The objects of FOLDER/FRAME.txt for every frame; a missing file counts as empty (see `read_pair`).

    files  frame -> file name, where it is not FRAME.txt
    Raises InputError (unless lenient) with file, line and column of the first broken line; also when lenient, if no
    line of a label folder can be read: it would pass for one without objects.
    """
    width = 15 if scored else 14
    counts, lines, names, longer = [], [], [], []
    passed_over = len(problems.found)
    numbers = array("d")  # a list of Python floats would take four times the memory
    for frame in frames:
        path = os.path.join(folder, (files or {}).get(frame, f"{frame}.txt"))
        kept = 0
        for number, line in _file_lines(path, problems):
            fields = line.split()
            try:
                numbers.extend(_numbers(fields, line, width, f"{path}:{number}", scored))
            except ValueError as error:
                problems.report(BROKEN_LINE, str(error))
                continue
            names.append(fields[0])
            lines.append(number)
            kept += 1
            if len(fields) > width + 1:
                longer.append(len(fields))
        counts.append(kept)
    broken = [message for kind, message in problems.found[passed_over:] if kind == BROKEN_LINE]
    if broken and not names and not scored:
        raise InputError(f"{folder}: none of {len(broken)} lines can be read; the first: {broken[0]}")
    if longer:
        problems.notes.append(_about_columns(folder, longer, width + 1, len(names)))
    values = np.full((len(names), 15), np.nan)
    values[:, :width] = np.asarray(numbers).reshape(-1, width)
    return build_table(frames, counts, names, values, lines)


def _about_columns(folder: Path, longer: Sequence[int], read: int, lines: int) -> str:
    widths = sorted(set(longer))
    found = f"{widths[0]}" if len(widths) == 1 else f"{widths[0]} to {widths[-1]}"
    return (
        f"{folder}: {len(longer)} of {lines} lines have {found} columns; the first {read} are read, as the devkit does"
    )


def _file_lines(path: str, problems: Problems) -> list[tuple[int, str]]:
    """(line number, text) of every line that is not blank; nothing for a file that is not there."""
    try:
        with open(path, "rb") as file:
            text = decode_text(file.read())
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except ValueError as error:
        problems.report(BROKEN_LINE, f"{path}: {error}")
        return []
    return [(number, line) for number, line in enumerate(text.splitlines(), start=1) if not line.isspace() and line]


def _numbers(fields: list[str], line: str, width: int, where: str, scored: bool) -> list[float]:
    """The `width` numbers after the type. Raises ValueError naming the column when count, text or value is wrong."""
    if len(fields) > width:
        try:
            numbers = list(map(float, fields[1 : width + 1]))
        except ValueError:
            numbers = [math.nan]
        # One sum is far cheaper than a test per number: it is finite only if all of them are.
        if math.isfinite(sum(numbers)):
            return numbers
    parse_line(line, where=where, scored=scored)
    fields[:] = split_fields(line, width + 1)
    return list(map(float, fields[1 : width + 1]))
