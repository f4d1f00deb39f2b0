"""Result pickles of OpenPCDet and mmdetection3d as KITTI result lines.

Both write a list with one entry per frame that holds arrays over its objects: name, dimensions (l h w), location,
rotation_y, alpha, bbox, score. OpenPCDet names a frame by frame_id, mmdetection3d by sample_idx, once per object.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from detection.kitti_format import KittiObject
from pipeline.base.errors import DataError
from pipeline.base.paths import safe_id

_NEEDED = ("name", "dimensions", "location", "rotation_y", "score")
_IDS = ("frame_id", "sample_idx", "image_idx")
# Digits of KITTI's frame names.
_DIGITS = 6


@dataclass(frozen=True)
class ImportedResults:
    """Objects per frame, and what is worth a word about them."""

    frames: dict[str, list[KittiObject]]
    notes: tuple[str, ...] = ()


def read_results(content: Any, path: Path) -> ImportedResults:
    """The frames of a result pickle's content.

    Raises DataError for entries without the fields, for a frame that comes twice, and for values that are no numbers.
    """
    frames: dict[str, list[KittiObject]] = {}
    nameless, unboxed = 0, 0
    for index, entry in enumerate(_entries(content, path)):
        where = f"{path}: entry {index}"
        if not isinstance(entry, Mapping):
            raise DataError(where, "a frame (a dict of arrays)", type(entry).__name__)
        name = _frame_name(entry)
        objects = _objects(entry, where if name is None else f"{path}: frame {name}")
        if name is None:
            if objects:
                raise DataError(where, f"a frame's name ({', '.join(_IDS)})", ", ".join(map(str, entry)))
            nameless += 1
            continue
        if name in frames:
            raise DataError(where, "every frame once", f"frame {name} again")
        frames[name] = objects
        unboxed += sum(max(item.bbox) <= 0 for item in objects)
    return ImportedResults(frames, tuple(_notes(nameless, unboxed)))


def _notes(nameless: int, unboxed: int) -> list[str]:
    notes = []
    if nameless:
        notes.append(f"{nameless} empty entries do not say of which frame: evaluate with --missing empty")
    if unboxed:
        notes.append(
            f"{unboxed} objects have no 2D box: KITTI ignores what is less than 25 pixels high; --min-height none "
            "evaluates them by another rule than KITTI's ranking"
        )
    return notes


def _entries(content: Any, path: Path) -> Sequence[Any]:
    """The frames: a list, or mmdetection3d's dict of lists with the boxes of the LiDAR frame under one key."""
    if isinstance(content, Mapping):
        lists = [value for key, value in content.items() if "pred_instances_3d" in str(key) or key == "pts_bbox"]
        content = lists[0] if len(lists) == 1 else content
    if not isinstance(content, (list, tuple)):
        raise DataError(path, "a list of frames", type(content).__name__)
    return content


def _frame_name(entry: Mapping[str, Any]) -> str | None:
    """The name of a frame: 0 is 000000; None when the entry has none."""
    image = entry.get("image")
    found = next((entry[key] for key in _IDS if key in entry), None)
    if found is None and isinstance(image, Mapping):
        found = image.get("image_idx")
    if isinstance(found, bytes):
        found = found.decode("utf-8", errors="replace")
    if not isinstance(found, str):
        values = {value.item() for value in np.ravel(np.asarray([] if found is None else found))}
        if len(values) != 1:
            return None
        found = str(values.pop())
    text = found.strip()
    return safe_id(text.zfill(_DIGITS) if text.isascii() and text.isdigit() else text)


def _objects(entry: Mapping[str, Any], where: str) -> list[KittiObject]:
    """The objects of one entry; its dimensions are l h w, KITTI's lines have h w l."""
    missing = [key for key in _NEEDED if key not in entry]
    if missing and "boxes_lidar" in entry:
        hint = "results in the LiDAR frame need each frame's calibration: let the program write its KITTI form"
        raise DataError(where, ", ".join(_NEEDED), "boxes_lidar alone", hint)
    if missing:
        raise DataError(where, ", ".join(_NEEDED), f"no {', '.join(missing)}")
    count = len(entry["name"])
    columns = {
        key: _table(entry, key, count, width, default, where)
        for key, width, default in (
            ("dimensions", 3, None),
            ("location", 3, None),
            ("rotation_y", 1, None),
            ("score", 1, None),
            ("bbox", 4, 0.0),
            ("alpha", 1, -10.0),  # KITTI's mark for an angle that is not given
        )
    }
    rows = [[float(v) for v in np.concatenate([columns[key][i] for key in columns])] for i in range(count)]
    return [_object(str(name), row) for name, row in zip(entry["name"], rows)]


def _table(
    entry: Mapping[str, Any], key: str, count: int, width: int, default: float | None, where: str
) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(count, width) numbers of a field; `default` where it is not there or None."""
    if default is not None and (entry.get(key) is None or len(entry[key]) == 0):
        return np.full((count, width), default)
    try:
        table = np.asarray(entry[key], dtype=np.float64).reshape(count, width)
    except (ValueError, TypeError) as error:
        raise DataError(where, f"{count} x {width} numbers as {key}", str(error)) from None
    bad = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if len(bad):
        raise DataError(where, f"finite numbers as {key}", f"{table[bad[0]]} for object {bad[0]}")
    return table


def _object(name: str, row: list[float]) -> KittiObject:
    l, h, w, x, y, z, ry, score, x1, y1, x2, y2, alpha = row
    return KittiObject(name, -1, -1, alpha, (x1, y1, x2, y2), (h, w, l), (x, y, z), ry, score)
