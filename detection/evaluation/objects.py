"""Every object of a folder in one table of numbers: what the kernels of the evaluation work on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detection.kitti_format import KittiObject

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Columns of `ObjectTable.values`, in the order of a KITTI line after the type.
TRUNCATED, OCCLUDED, ALPHA = 0, 1, 2
BBOX = slice(3, 7)
H, W, L, X, Y, Z, RY, SCORE = 7, 8, 9, 10, 11, 12, 13, 14
BOX_3D = (X, Y, Z, H, W, L, RY)

FrameObjects = Mapping[str, Sequence[KittiObject]] | Sequence[Sequence[KittiObject]]


@dataclass(frozen=True)
class ObjectTable:
    """All objects of a sequence of frames.

    frames   F frame names in the order of evaluation
    offsets  (F + 1,) int64; objects of frame i are rows offsets[i] to offsets[i + 1]
    types    the distinct type names, as written
    type     (N,) int64, index into `types`
    values   (N, 15) float64: truncated occluded alpha x1 y1 x2 y2 h w l x y z ry score (score NaN in labels)
    line     (N,) int64, line of the object in its file, from 1
    """

    frames: tuple[str, ...]
    offsets: NDArray[np.int64]
    types: tuple[str, ...]
    type: NDArray[np.int64]
    values: Array
    line: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.values)

    @property
    def height_2d(self) -> Array:
        """(N,) y2 - y1 of the 2D box in pixels."""
        return np.asarray(self.values[:, 6] - self.values[:, 4])

    @property
    def score(self) -> Array:
        """(N,) scores; NaN in labels."""
        return np.ascontiguousarray(self.values[:, SCORE])

    @property
    def alpha(self) -> Array:
        """(N,) observation angle in radians; -10 where not given."""
        return np.ascontiguousarray(self.values[:, ALPHA])

    @property
    def boxes_2d(self) -> Array:
        """(N, 4) x1 y1 x2 y2 in pixels."""
        return np.ascontiguousarray(self.values[:, BBOX])

    @property
    def boxes_3d(self) -> Array:
        """(N, 7) x y z h w l ry in KITTI's camera form."""
        return np.ascontiguousarray(self.values[:, BOX_3D])

    @property
    def frame(self) -> NDArray[np.int64]:
        """(N,) index of each object's frame."""
        return np.repeat(np.arange(len(self.frames)), np.diff(self.offsets))

    def is_type(self, *names: str) -> Mask:
        """(N,) whether the type is one of `names`, upper and lower case alike (as strcasecmp in the devkit)."""
        wanted = {name.lower() for name in names}
        hit = np.array([name.lower() in wanted for name in self.types], dtype=bool)
        return hit[self.type] if len(hit) else np.zeros(len(self), dtype=bool)

    def is_exactly(self, name: str) -> Mask:
        """(N,) whether the type is written exactly like `name`."""
        hit = np.array([written == name for written in self.types], dtype=bool)
        return hit[self.type] if len(hit) else np.zeros(len(self), dtype=bool)

    def rows(self, frame_index: int) -> range:
        """Row numbers of one frame."""
        return range(int(self.offsets[frame_index]), int(self.offsets[frame_index + 1]))

    def with_boxes_3d(self, boxes: Array) -> ObjectTable:
        """The same objects with other (N, 7) x y z h w l ry."""
        values = self.values.copy()
        values[:, BOX_3D] = boxes
        return ObjectTable(self.frames, self.offsets, self.types, self.type, values, self.line)


def build_table(
    frames: Sequence[str],
    counts: Sequence[int],
    names: Sequence[str],
    values: Array,
    lines: Sequence[int],
) -> ObjectTable:
    """An ObjectTable from per-frame counts and per-object type names, values (N, 15) and line numbers."""
    codes: dict[str, int] = {}
    type_codes = [codes.setdefault(name, len(codes)) for name in names]
    return ObjectTable(
        frames=tuple(frames),
        offsets=np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]).astype(np.int64),
        types=tuple(codes),
        type=np.array(type_codes, dtype=np.int64),
        values=np.ascontiguousarray(values, dtype=np.float64).reshape(-1, 15),
        line=np.array(lines, dtype=np.int64),
    )


def named_frames(frames: FrameObjects) -> Mapping[str, Sequence[KittiObject]]:
    """Objects per frame name; a plain sequence of frames is numbered 000000, 000001, ..."""
    if isinstance(frames, Mapping):
        return frames
    return {f"{index:06d}": objects for index, objects in enumerate(frames)}


def table_of(frames: Sequence[str], objects: Iterable[Sequence[KittiObject]], *, scored: bool) -> ObjectTable:
    """An ObjectTable from objects in memory, one sequence per frame.

    Raises ValueError when a result has no score or a value is NaN or infinite, naming frame and place.
    """
    counts, names, lines, rows = [], [], [], []
    for frame, items in zip(frames, objects, strict=True):
        counts.append(len(items))
        for place, item in enumerate(items, start=1):
            if scored and item.score is None:
                raise ValueError(f"{frame}:{place}: expected a detection with a score, got a label without one")
            names.append(item.type)
            lines.append(place)
            score = item.score if scored and item.score is not None else np.nan
            rows.append(
                (item.truncated, item.occluded, item.alpha, *item.bbox, *item.size, *item.location, item.ry, score)
            )
    table = build_table(frames, counts, names, np.array(rows, dtype=np.float64).reshape(-1, 15), lines)
    checked = table.values if scored else table.values[:, :SCORE]
    bad = np.flatnonzero(~np.isfinite(checked).all(axis=1))
    if len(bad):
        raise ValueError(f"{table.frames[table.frame[bad[0]]]}:{table.line[bad[0]]}: NaN or infinite value")
    return table
