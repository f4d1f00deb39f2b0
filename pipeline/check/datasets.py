"""Examination of a data set: frames through workers, then what only shows when frames are compared.

What is kept of a frame is a few numbers; the maps for comparing images with clouds live in a window of five frames.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from pipeline.check.clouds import CloudFacts
from pipeline.check.faults import Finding
from pipeline.check.frames import FrameFacts, Place, examine_frame
from pipeline.check.images import CROP_SHIFTS, OFFSETS, Structure, agreement
from pipeline.data.dataset import Dataset
from pipeline.export.workers import map_ordered

# Parts whose absence is noticed when most frames have them.
_EXPECTED = ("image", "points", "calibration", "labels", "sparse_depth", "target_depth")
_SAME_RIG = frozenset({"kitti_object", "kitti_depth", "kitti_raw"})
_REACH = max(OFFSETS)


@dataclass
class Comparison:
    """Numbers gathered over the frames of a data set."""

    layout: str
    root: str
    present: dict[str, frozenset[str]] = field(default_factory=dict)
    declared: dict[str, frozenset[str]] = field(default_factory=dict)
    digests: dict[str, dict[bytes, str]] = field(default_factory=dict)
    repeated: dict[tuple[str, str], set[str]] = field(default_factory=dict)
    hashed: dict[str, int] = field(default_factory=dict)
    clouds: dict[str, CloudFacts] = field(default_factory=dict)
    rigs: dict[tuple[int, int], dict[tuple[float, ...], list[str]]] = field(default_factory=dict)
    tall_cars: int = 0
    all_cars: int = 0
    label_columns: dict[str, int] = field(default_factory=dict)
    empty_points: dict[str, int] = field(default_factory=dict)
    gains: dict[str, tuple[float, ...]] = field(default_factory=dict)
    scores: dict[str, dict[int, float]] = field(default_factory=dict)
    window: deque[tuple[str, Structure | None]] = field(default_factory=deque)

    def add(self, facts: FrameFacts) -> None:
        """Takes the numbers of one frame, in the order of the frames."""
        self.present[facts.frame] = facts.present & frozenset(_EXPECTED)
        self.declared[facts.frame] = facts.declared & frozenset(_EXPECTED)
        self.hashed[facts.frame] = len(facts.hashes)
        for part, digest in facts.hashes:
            first = self.digests.setdefault(part, {}).setdefault(digest, facts.frame)
            if first != facts.frame:
                self.repeated.setdefault((first, facts.frame), set()).add(part)
        if facts.cloud is not None:
            self.clouds[facts.frame] = facts.cloud
        if facts.size is not None and facts.rig is not None:
            self.rigs.setdefault(facts.size, {}).setdefault(facts.rig, []).append(facts.frame)
        self.tall_cars += facts.cars[0]
        self.all_cars += facts.cars[1]
        self.label_columns[facts.frame] = facts.label_columns
        self.empty_points[facts.frame] = facts.empty_points
        if facts.gains:
            self.gains[facts.frame] = facts.gains
        self._compare(facts)

    def _compare(self, facts: FrameFacts) -> None:
        """Agreement of this frame's cloud with earlier images and of its image with earlier clouds."""
        self.window.append((facts.frame, facts.structure))
        if len(self.window) > _REACH + 1:
            self.window.popleft()
        if facts.structure is None:
            return
        last = len(self.window) - 1
        for position, (frame, other) in enumerate(self.window):
            if other is None:
                continue
            distance = last - position
            self.scores.setdefault(facts.frame, {})[-distance] = agreement(facts.structure, other)
            self.scores.setdefault(frame, {})[distance] = agreement(other, facts.structure)

    def findings(self) -> Iterator[Finding]:
        """What shows only in comparison."""
        yield from self._missing()
        yield from self._repeated()
        yield from self._truncated()
        yield from self._other_rigs()
        yield from self._offsets()
        yield from self._shifted()
        yield from self._gaps()
        if self.all_cars >= 20 and self.tall_cars > 0.8 * self.all_cars:
            message = f"{self.tall_cars} of {self.all_cars} cars are higher than wide: height and width exchanged?"
            yield Finding("swapped_dimensions", "", self.root, message)

    def notes(self) -> list[str]:
        """What the frames have that is taken though the layout has it otherwise."""
        found = []
        wide = [columns for columns in self.label_columns.values() if columns > 15]
        if wide:
            found.append(f"{self.root}: {len(wide)} label files have up to {max(wide)} columns; the first 15 are read")
        empty = [count for count in self.empty_points.values() if count]
        if empty:
            found.append(
                f"{self.root}: {sum(empty)} points without a return (NaN or 0 0 0) are left out of {len(empty)} clouds"
            )
        return found

    def _missing(self) -> Iterator[Finding]:
        counts = Counter(part for parts in self.present.values() for part in parts)
        expected = {part for part, count in counts.items() if 2 * count > len(self.present)}
        for frame, parts in self.present.items():
            wanted = expected | self.declared[frame]
            lacking = sorted(wanted - parts)
            if not lacking:
                continue
            alone = len(wanted) > 2 and len(self.present) > 1 and len(parts & wanted) <= 1
            fault = "extra_file" if alone else "missing_file"
            message = f"only {', '.join(sorted(parts)) or 'other files'}" if alone else f"no {', '.join(lacking)}"
            yield Finding(fault, frame, self.root, f"{message}; {len(self.present)} frames in all")

    def _repeated(self) -> Iterator[Finding]:
        for (first, second), parts in self.repeated.items():
            if len(parts) == self.hashed[second]:
                yield Finding(
                    "duplicated_frame", second, self.root, f"same {', '.join(sorted(parts))} as frame {first}"
                )
            else:
                message = f"same {', '.join(sorted(parts))} as frame {first}, other files differ"
                yield Finding("index_offset", second, self.root, message)

    def _truncated(self) -> Iterator[Finding]:
        if len(self.clouds) < 4:
            return
        middle = float(np.median([facts.count for facts in self.clouds.values()]))
        floor = float(np.median([facts.floor for facts in self.clouds.values()]))
        for frame, facts in self.clouds.items():
            # Rows are stored from the top: a cut file lacks the ground near the car.
            cut = facts.count < 0.8 * middle and facts.floor > floor + 3
            if facts.count < 0.4 * middle or cut:
                message = f"{facts.count} points down to {facts.floor:.1f} degrees; usual: {middle:.0f}, {floor:.1f}"
                yield Finding("truncated_cloud", frame, self.root, message)

    def _other_rigs(self) -> Iterator[Finding]:
        if self.layout not in _SAME_RIG:
            return
        for size, rigs in self.rigs.items():
            usual = max(rigs, key=lambda rig: len(rigs[rig]))
            for rig, frames in rigs.items():
                if rig != usual and len(rigs[usual]) >= 3 and len(frames) < 0.5 * len(rigs[usual]):
                    for frame in frames:
                        message = (
                            f"calibration differs from the other {len(rigs[usual])} frames of {size[1]} x {size[0]}"
                        )
                        yield Finding("other_rigs_calibration", frame, self.root, message)

    def _offsets(self) -> Iterator[Finding]:
        """Images that fit the cloud of another frame: in the whole set, or two frames exchanged."""
        complete = {f: s for f, s in self.scores.items() if 0 in s}
        for offset in OFFSETS:
            gains = np.array([s[offset] - s[0] for s in complete.values() if offset in s])
            if len(gains) >= 4 and gains.mean() > 0.05 and gains.mean() > 3 * gains.std() / np.sqrt(len(gains)):
                message = f"clouds fit the images {abs(offset)} frame(s) {'later' if offset > 0 else 'earlier'}"
                for frame, scores in complete.items():
                    if offset in scores:
                        yield Finding("index_offset", frame, self.root, message)
                return
        names = list(self.present)
        for position, frame in enumerate(names):
            for offset in (offset for offset in OFFSETS if offset > 0 and position + offset < len(names)):
                other = names[position + offset]
                if frame in complete and other in complete and _exchanged(complete[frame], complete[other], offset):
                    message = f"images of {frame} and {other} fit each other's clouds"
                    yield Finding("index_offset", frame, self.root, message)
                    yield Finding("index_offset", other, self.root, message)

    def _shifted(self) -> Iterator[Finding]:
        """A crop that was not undone in any frame."""
        if len(self.gains) < 4:
            return
        gains = np.array(list(self.gains.values()))
        means, errors = gains.mean(axis=0), gains.std(axis=0) / np.sqrt(len(gains))
        best = int(np.argmax(means))
        if means[best] > 0.04 and means[best] > 3 * errors[best]:
            rows, columns = (4 * cells for cells in CROP_SHIFTS[best])
            for frame in self.gains:
                message = f"images and clouds fit when the images are moved by about {-rows} rows, {-columns} columns"
                yield Finding("wrong_crop", frame, self.root, message)

    def _gaps(self) -> Iterator[Finding]:
        """Numbers left out of KITTI's running numbers, when nearly all are there."""
        if self.layout != "kitti_object" or len(self.present) < 10 or not all(f.isdigit() for f in self.present):
            return
        numbers = {int(frame) for frame in self.present}
        absent = sorted(set(range(min(numbers), max(numbers))) - numbers)
        if 10 * len(absent) <= len(numbers):
            for number in absent:
                message = f"frames {min(numbers):06d} to {max(numbers):06d} are there but for {len(absent)}"
                yield Finding("missing_file", f"{number:06d}", self.root, message)


def _exchanged(scores: dict[int, float], other: dict[int, float], offset: int) -> bool:
    """True when both frames' clouds fit the other's image clearly better than their own."""
    if offset not in scores or -offset not in other:
        return False
    gains = (scores[offset] - scores[0], other[-offset] - other[0])
    return min(gains) > 0.04 and sum(gains) > 0.15 and max(scores[0], other[0]) < 0.08


def examine_dataset(
    dataset: Dataset, workers: int, progress: Callable[[str], None] | None = None, notes: list[str] | None = None
) -> Iterator[Finding]:
    """Findings of every frame of a data set and of their comparison; `notes` gets what is worth a word though sound."""
    comparison = Comparison(dataset.name, dataset.root)
    for path in dataset.strays:
        yield Finding("extra_file", path.stem, str(path), f"belongs to none of {len(dataset)} frames")
    task = partial(examine_frame, dataset.open)
    for facts in map_ordered(task, places(dataset), workers):
        yield from facts.findings
        comparison.add(facts)
        if progress is not None:
            progress(facts.frame)
    yield from comparison.findings()
    if notes is not None:
        notes += comparison.notes()


def places(dataset: Dataset) -> Iterable[Place]:
    """Every frame with its neighbours."""
    for index, frame in enumerate(dataset.ids):
        around = (index + offset for offset in OFFSETS)
        neighbours = tuple(dataset.ids[i] for i in around if 0 <= i < len(dataset.ids))
        yield Place(frame, neighbours, dataset.name)
