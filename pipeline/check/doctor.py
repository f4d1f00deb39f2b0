"""The doctor: finds out what a folder is, examines it, and gives a report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pipeline.base.errors import DataError, UsageError
from pipeline.check.datasets import examine_dataset
from pipeline.check.faults import FAULTS, Finding, causes
from pipeline.check.frames import Place, open_present
from pipeline.check.images import OFFSETS
from pipeline.check.infos import examine_infos
from pipeline.check.outputs import (
    examine_depth_frame,
    examine_labels_frame,
    examine_results_frame,
    examine_run_frame,
)
from pipeline.check.virtual import examine_sfd, examine_virconv
from pipeline.data import READERS, open_dataset
from pipeline.data.dataset import Dataset, read_split
from pipeline.data.frame import Frame
from pipeline.data.nyuv2 import open_nyuv2_full
from pipeline.export.source import in_run
from pipeline.export.workers import default_workers, map_ordered

Examine = Callable[[Callable[[str], Frame], Path, Place, str], list[Finding]]

# Folders made from a data set, frame by frame: (folder with a file per frame, its suffix, examination).
FOLDERS: dict[str, tuple[str, str, Examine]] = {
    "sfd": ("depth_pseudo_rgbseguv_twise", ".bin", examine_sfd),
    "virconv": ("velodyne_depth", ".npy", examine_virconv),
    "run": ("depth", ".png", examine_run_frame),
    "depth": (".", ".png", examine_depth_frame),
    "results": (".", ".txt", examine_results_frame),
    "labels": (".", ".txt", examine_labels_frame),
}
INFOS = ("openpcdet", "mmdet3d")
FORMATS = (*READERS, *INFOS, *FOLDERS)


@dataclass(frozen=True)
class Report:
    """Result of a check: what was examined, how many frames, and the findings (empty when nothing is wrong).

    notes  what is taken though it is not written as the format has it
    """

    path: str
    format: str
    frames: int
    findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()

    @property
    def clean(self) -> bool:
        """True when nothing is wrong."""
        return not self.findings

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "path": self.path,
            "format": self.format,
            "frames": self.frames,
            "clean": self.clean,
            "faults": dict(Counter(finding.fault for finding in self.findings)),
            "findings": [finding.as_dict() for finding in self.findings],
            "notes": list(self.notes),
        }

    def lines(self, shown: int = 5) -> Iterator[str]:
        """For people: a line per fault with its count and advice, and its first places."""
        verdict = "nothing wrong" if self.clean else f"{len(self.findings)} findings"
        yield f"{self.path}: {self.format}, {self.frames} frames, {verdict}"
        for fault, count in Counter(finding.fault for finding in self.findings).most_common():
            yield f"  {fault} ({count}): {FAULTS[fault].advice}"
            places = [finding for finding in self.findings if finding.fault == fault]
            yield from (f"    {f.frame or '-'} {f.where}: {f.message}" for f in places[:shown])
            if count > shown:
                yield f"    ... and {count - shown} more"
        yield from (f"  note: {note}" for note in self.notes)


def check(
    path: Path,
    format_name: str | None = None,
    reference: Dataset | None = None,
    frames: str | None = None,
    workers: int | None = None,
    progress: Callable[[str], None] | None = None,
    columns: int | None = None,
) -> Report:
    """Examines a data set or an exported folder.

    format_name  one of FORMATS, or None to find out
    reference    the data set that a run, a depth or a result folder was made from
    frames       selection of the frames (see `Dataset.select`), all when None
    workers      processes; None: all cores
    columns      float32 numbers per point of .bin clouds, when they are not x y z intensity
    Raises UsageError when the folder is not recognised or a reference is needed.
    """
    if not path.exists():
        raise UsageError(f"no such folder: {path}")
    kind = format_name or recognise(path)
    if kind not in FORMATS:
        raise UsageError(f"unknown format {kind!r}; known: {', '.join(FORMATS)}")
    notes: list[str] = []
    if kind in FOLDERS:
        count, findings = _check_folder(path, kind, reference, frames, workers, progress)
    else:
        dataset = open_checked(kind, path, columns)
        dataset = dataset.select(frames) if frames else dataset
        count = len(dataset)
        notes += dataset.notes
        findings = examine_dataset(dataset, workers or default_workers(count), progress, notes)
    found = [*findings, *_check_infos(path, kind), *_check_splits(path)]
    return Report(str(path), kind, count, tuple(causes(found)), tuple(notes))


def open_checked(kind: str, path: Path, columns: int | None = None) -> Dataset:
    """The data set of a format; NYU frames as they are stored, info formats by their KITTI folders."""
    name = "kitti_object" if kind in INFOS else kind
    dataset = open_nyuv2_full(path) if kind == "nyuv2" else open_dataset(name, path, columns)
    return replace(dataset, open=partial(open_present, dataset.open))


def recognise(path: Path) -> str:
    """The format of a folder. Raises UsageError when nothing fits."""
    trees = [path, path / "training", path / "testing"]
    for kind in ("sfd", "virconv"):
        if any((tree / FOLDERS[kind][0]).is_dir() for tree in trees):
            return kind
    if any(path.glob("kitti_infos_*.pkl")):
        return "mmdet3d" if (path / "training" / "velodyne_reduced").is_dir() else "openpcdet"
    if any((path / name).is_dir() for name in ("cloud", "detections")) and not (path / "images").is_dir():
        return "run"
    for kind, opener in (*READERS.items(), ("nyuv2", open_nyuv2_full)):
        try:
            opener(path)
            return kind
        except (UsageError, DataError):
            continue
    raise UsageError(f"{path}: not recognised; name its format with --format (one of {', '.join(FORMATS)})")


# ---- folders made from a data set ---------------------------------------------------------------------------------


def _check_folder(
    path: Path,
    kind: str,
    reference: Dataset | None,
    frames: str | None,
    workers: int | None,
    progress: Callable[[str], None] | None,
) -> tuple[int, Iterator[Finding]]:
    """Number of frames and findings of a folder with files per frame."""
    name, suffix, examine = FOLDERS[kind]
    tree = next((tree for tree in (path / "training", path / "testing", path) if (tree / name).is_dir()), path)
    files = sorted(p.relative_to(tree / name).with_suffix("").as_posix() for p in (tree / name).rglob(f"*{suffix}"))
    if not files and kind != "run":
        raise UsageError(f"{tree / name}: no {suffix} file in it")
    dataset = _reference(path, kind, reference)
    names = _frame_ids(path)
    found = {names.get(file, file): file for file in files}
    wanted = dataset.select(frames).ids if frames else dataset.ids
    expected = _expected(path, wanted, names, found, kind)
    known = frozenset(dataset.ids)
    present = found if kind != "run" else {frame for frame in dataset.ids if in_run(path, frame)}
    places = [_place(dataset.ids, index) for index, frame in enumerate(dataset.ids) if frame in present]
    task = partial(_examine_one, dataset.open, tree, examine, found)

    def findings() -> Iterator[Finding]:
        for frame in expected:
            if frame not in found:
                yield Finding("missing_file", frame, str(tree / name / f"{frame}{suffix}"), "listed, but not there")
        for frame, file in found.items():
            if frame not in known:
                message = f"{dataset.root} has no such frame"
                yield Finding("extra_file", frame, str(tree / name / f"{file}{suffix}"), message)
        for place, result in zip(places, map_ordered(task, places, workers or default_workers(len(places)))):
            yield from result
            if progress is not None:
                progress(place.frame)

    return len(places), findings()


def _examine_one(
    open_frame: Callable[[str], Frame], tree: Path, examine: Examine, files: dict[str, str], place: Place
) -> list[Finding]:
    """One frame in a worker."""
    try:
        return examine(open_frame, tree, place, files.get(place.frame, place.frame))
    except DataError as error:
        return [Finding("unreadable_file", place.frame, error.where, str(error))]


def _place(ids: tuple[str, ...], index: int) -> Place:
    around = (index + offset for offset in OFFSETS)
    return Place(ids[index], tuple(ids[i] for i in around if 0 <= i < len(ids)), "")


def _reference(path: Path, kind: str, reference: Dataset | None) -> Dataset:
    """The data set given, or the KITTI folders beside the files."""
    if reference is not None:
        return reference
    if kind in ("sfd", "virconv"):
        return open_checked("kitti_object", path)
    if kind in ("results", "labels"):
        files = sorted(p.stem for p in path.glob("*.txt"))
        return Dataset(tuple(files), partial(_bare_frame, str(path)), "", str(path))
    raise UsageError(f"checking a {kind} folder needs the data set it was made from: give it with --data")


def _bare_frame(where: str, frame_id: str) -> Frame:
    return Frame(frame_id, {}, where)


def _frame_ids(path: Path) -> dict[str, str]:
    """Consumer's name -> frame id, when an export renumbered the frames (frames.txt)."""
    table = path / "frames.txt"
    if not table.is_file():
        return {}
    rows = (line.split(maxsplit=1) for line in table.read_text(encoding="utf-8").splitlines() if line.strip())
    return dict(rows)


def _expected(
    path: Path, wanted: tuple[str, ...], names: dict[str, str], found: dict[str, str], kind: str
) -> list[str]:
    """Frames that should have a file: the export's split lists, else the data set when most of it is there."""
    lists = [file for file in (path / "ImageSets").glob("*.txt") if file.stem != "test"]
    listed = {names.get(name, name) for file in lists for name in read_split(file)}
    if listed and kind in ("sfd", "virconv"):
        return [frame for frame in wanted if frame in listed]
    present = sum(frame in found for frame in wanted)
    return list(wanted) if 2 * present > len(wanted) else []


# ---- files about all frames ---------------------------------------------------------------------------------------


def _check_infos(path: Path, kind: str) -> Iterator[Finding]:
    return examine_infos(path, kind) if kind in INFOS else iter(())


def _check_splits(path: Path) -> Iterator[Finding]:
    """Frames that are in the train and in the val list."""
    lists = path / "ImageSets"
    parts = [set(read_split(lists / f"{name}.txt")) for name in ("train", "val") if (lists / f"{name}.txt").is_file()]
    if len(parts) == 2 and parts[0] & parts[1]:
        shared = sorted(parts[0] & parts[1])
        yield Finding(
            "split_overlap", "", str(lists), f"{len(shared)} frames in train and val: {', '.join(shared[:3])}"
        )
