"""Export of a run: frames through worker processes into a consumer's layout, index files at the end."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from auglidar_base.atomic import write_text
from pipeline.base.errors import DataError, UsageError
from pipeline.base.paths import RunFolder
from pipeline.data.dataset import Dataset
from pipeline.data.frame import Frame
from pipeline.export.disk_buffer import DiskBuffer
from pipeline.export.formats import FORMATS
from pipeline.export.record import VIRTUAL, Options, Record
from pipeline.export.source import ExportFrame, consumer_names, read_splits
from pipeline.export.workers import map_ordered


@dataclass
class Summary:
    """What an export did: frames written, sums and maxima of their records, failures (id -> reason), index files."""

    frames: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    largest: dict[str, float] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    indexes: list[Path] = field(default_factory=list)

    def add(self, record: Record) -> None:
        """Counts one frame."""
        self.frames += 1
        for name, number in record.counts.items():
            self.counts[name] = self.counts.get(name, 0) + number
        for name, value in record.largest.items():
            self.largest[name] = max(self.largest.get(name, 0.0), value)


def export(
    dataset: Dataset,
    run: Path | None,
    out: Path,
    format_name: str,
    options: Options,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> Summary:
    """Writes every frame of `dataset` (and what `run` made of it) in a consumer's layout below `out`.

    A frame that cannot be exported is noted in the summary and in OUT/failures.json, and the others go on.
    Raises UsageError for an unknown format or quirk and for a format that needs a run when there is none.
    """
    format_ = FORMATS[check_request(format_name, run, options)]
    names = consumer_names(dataset.ids)
    splits = read_splits(Path(dataset.root), dataset.ids)
    training = frozenset(splits.get("train", ()))
    items = [(frame_id, names[frame_id], frame_id in training) for frame_id in dataset.ids]
    task = partial(_one_frame, dataset.open, run, out, format_name, options)
    summary = Summary()
    with ExitStack() as stack:
        buffers: dict[str, DiskBuffer] = {}
        done: list[str] = []
        for frame_id, outcome in map_ordered(task, items, workers):
            if isinstance(outcome, str):
                summary.failures[frame_id] = outcome
            else:
                summary.add(outcome)
                done.append(names[frame_id])
                _keep(outcome.entries, buffers, stack)
            if progress is not None:
                progress(frame_id)
        members = {split: frozenset(names[frame_id] for frame_id in ids) for split, ids in splits.items()}
        if format_.finish is not None:
            summary.indexes += format_.finish(out, buffers, done, members)
    _write_lists(out, dataset.ids, names, splits if format_.splits else {}, summary)
    return summary


def check_request(format_name: str, run: Path | None, options: Options) -> str:
    """`format_name` when the request can be carried out. Raises UsageError that says why not."""
    if format_name not in FORMATS:
        raise UsageError(f"unknown export format {format_name!r}; known: {', '.join(FORMATS)}")
    format_ = FORMATS[format_name]
    if format_.needs and run is None:
        raise UsageError(f"format {format_name} needs the {format_.needs} of a run: give the run folder with --run")
    if options.virtual not in VIRTUAL:
        raise UsageError(f"unknown choice of virtual points {options.virtual!r}; known: {', '.join(VIRTUAL)}")
    unknown = sorted(options.compat - set(format_.compat))
    if unknown:
        known = ", ".join(format_.compat) or "none"
        raise UsageError(f"format {format_name} has no compat option {unknown[0]!r}; known: {known}")
    return format_name


def _one_frame(
    open_frame: Callable[[str], Frame],
    run: Path | None,
    out: Path,
    format_name: str,
    options: Options,
    one: tuple[str, str, bool],
) -> tuple[str, Record | str]:
    """Exports the frame `one` = (id, consumer's name, in the training split); runs in a worker.

    A frame's own trouble comes back as text.
    """
    frame_id, name, train = one
    item = ExportFrame(open_frame(frame_id), None if run is None else RunFolder(run), name, train)
    try:
        return frame_id, FORMATS[format_name].write_frame(item, out, options)
    except DataError as error:
        return frame_id, str(error)


def _keep(entries: Iterable[tuple[str, bytes]], buffers: dict[str, DiskBuffer], stack: ExitStack) -> None:
    """Puts a frame's index entries on disk until the end."""
    for name, data in entries:
        if name not in buffers:
            buffers[name] = DiskBuffer()
            stack.callback(buffers[name].close)
        buffers[name].add(data)


def _write_lists(
    out: Path,
    frame_ids: tuple[str, ...],
    names: dict[str, str],
    splits: dict[str, tuple[str, ...]],
    summary: Summary,
) -> None:
    """ImageSets/SPLIT.txt of the frames that were written, frames.txt when they were renumbered, failures.json."""
    for split, ids in splits.items():
        lines = [f"{names[frame_id]}\n" for frame_id in ids if frame_id not in summary.failures]
        write_text(out / "ImageSets" / f"{split}.txt", "".join(lines))
    if any(names[frame_id] != frame_id for frame_id in frame_ids):
        write_text(out / "frames.txt", "".join(f"{names[frame_id]} {frame_id}\n" for frame_id in frame_ids))
    failures = out / "failures.json"
    if summary.failures:
        write_text(failures, json.dumps(summary.failures, indent=1) + "\n")
    else:
        failures.unlink(missing_ok=True)
