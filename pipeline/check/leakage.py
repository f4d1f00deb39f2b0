"""Leakage: which frames of an evaluation share a raw drive with the training data of a model?

Depth networks are trained on raw KITTI drives, of which the object benchmark's frames are a sample; a detector that is
fed their depth has then seen its validation scenes (Simonelli et al., "Are we missing confidence in pseudo-LiDAR
methods for monocular 3D object detection?", ICCV 2021).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.errors import DataError, UsageError

_DRIVE = re.compile(r"(\d{4}_\d{2}_\d{2}_drive_\d{4})(?:_sync)?")
_FRAME = re.compile(r"(\d{10})")
# The 13 validation drives of the KITTI depth benchmark; its other drives are for training (depth devkit readme).
DEPTH_VAL_DRIVES = frozenset(
    f"{day}_drive_{number}"
    for day, numbers in {
        "2011_09_26": ("0002", "0005", "0013", "0020", "0023", "0036", "0079", "0095", "0113"),
        "2011_09_28": ("0037",),
        "2011_09_29": ("0026",),
        "2011_09_30": ("0016",),
        "2011_10_03": ("0047",),
    }.items()
    for number in numbers
)
BUILT_IN = "kitti_depth_train"


@dataclass(frozen=True)
class RawFrame:
    """A frame of a raw drive: ("2011_09_26_drive_0005", 109)."""

    drive: str
    number: int


@dataclass(frozen=True)
class Leakage:
    """Result: frames checked, those that share a drive (or are the very same frame) with training, and per drive."""

    frames: int
    shared_drive: tuple[str, ...]
    shared_frame: tuple[str, ...]
    drives: dict[str, int]

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "frames": self.frames,
            "leaking": len(self.shared_drive),
            "clean": not self.shared_drive,
            "shared_drive": list(self.shared_drive),
            "shared_frame": list(self.shared_frame),
            "drives": self.drives,
        }


def read_mapping(folder: Path) -> dict[str, RawFrame]:
    """Object frame id -> raw frame, from the devkit's train_mapping.txt and train_rand.txt.

    Frame i (from 0) is line train_rand[i] (from 1) of train_mapping.txt. Raises UsageError when a file is absent,
    DataError when they do not fit.
    """
    texts = []
    for name in ("train_mapping.txt", "train_rand.txt"):
        if not (folder / name).is_file():
            raise UsageError(f"{folder / name}: no such file (expected the mapping of KITTI's object devkit)")
        texts.append((folder / name).read_text(encoding="utf-8"))
    lines = [line.split() for line in texts[0].splitlines() if line.strip()]
    order = [int(word) for word in texts[1].replace(",", " ").split()]
    if any(len(line) < 3 for line in lines) or not order or not 1 <= min(order) <= max(order) <= len(lines):
        raise DataError(folder, "three columns per mapping line and line numbers from 1", f"{len(lines)} lines")
    rows = [lines[number - 1] for number in order]
    return {f"{i:06d}": RawFrame(drive_name(row[1]), int(row[2])) for i, row in enumerate(rows)}


def drive_name(text: str) -> str:
    """ "2011_09_26_drive_0005" of any text that holds it. Raises UsageError when there is none."""
    match = _DRIVE.search(text)
    if match is None:
        raise UsageError(f"{text!r} names no raw drive (expected e.g. 2011_09_26_drive_0005_sync)")
    return match.group(1)


@dataclass(frozen=True)
class Training:
    """What a model was trained on: drives, single raw frames (of these drives), or every drive but some."""

    drives: frozenset[str]
    frames: frozenset[RawFrame]
    all_but: frozenset[str] | None = None

    def holds(self, drive: str) -> bool:
        """True when the drive was (partly) used in training."""
        return drive in self.drives if self.all_but is None else drive not in self.all_but


def read_training(source: str, mapping: dict[str, RawFrame]) -> Training:
    """The training data of a model.

    source  "kitti_depth_train" (every drive but the depth benchmark's 13 validation drives), a folder with one
            sub-folder per drive, or a list: lines with a drive ("2011_09_26_drive_0001_sync", further columns or path
            parts allowed, a 10-digit frame number if given) or an object frame id ("000123")
    Raises UsageError for a line that is none of these.
    """
    if source == BUILT_IN:
        return Training(frozenset(), frozenset(), DEPTH_VAL_DRIVES)
    path = Path(source)
    if path.is_dir():
        drives = frozenset(drive_name(p.name) for p in path.rglob("*_drive_*") if p.is_dir())
        if not drives:
            raise UsageError(f"{path}: no folder of a raw drive in it")
        return Training(drives, frozenset())
    if not path.is_file():
        raise UsageError(f"no such training list: {source} (a file, a folder of drives, or {BUILT_IN})")
    found = [_training_line(line, mapping) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    frames = frozenset(RawFrame(drive, number) for drive, number in found if number is not None)
    return Training(frozenset(drive for drive, _ in found), frames)


def _training_line(line: str, mapping: dict[str, RawFrame]) -> tuple[str, int | None]:
    words = line.split()
    if _DRIVE.search(line) is None and words[0] in mapping:
        raw = mapping[words[0]]
        return raw.drive, raw.number
    number = _FRAME.search(line)
    return drive_name(line), None if number is None else int(number.group(1))


def find_leakage(frames: Iterable[str], mapping: dict[str, RawFrame], training: Training) -> Leakage:
    """Which of the object frames `frames` share a drive with the training data, and which were in it themselves.

    Raises UsageError for a frame that the mapping does not have.
    """
    listed = list(frames)
    unknown = [frame for frame in listed if frame not in mapping]
    if unknown:
        raise UsageError(f"{len(unknown)} of {len(listed)} frames are not in the mapping (first: {unknown[0]})")
    shared = [frame for frame in listed if training.holds(mapping[frame].drive)]
    same = [frame for frame in listed if mapping[frame] in training.frames]
    drives = Counter(mapping[frame].drive for frame in shared)
    return Leakage(len(listed), tuple(shared), tuple(same), dict(sorted(drives.items())))
