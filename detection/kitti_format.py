"""KITTI label and result lines as pure functions on text; files are read by `pipeline.data` and `detection.evaluation`.

Line: type truncated occluded alpha x1 y1 x2 y2 h w l x y z ry [score] (KITTI object devkit).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from detection.text import split_fields
from detection.types import Boxes3D

COLUMNS = (
    "type",
    "truncated",
    "occluded",
    "alpha",
    "x1",
    "y1",
    "x2",
    "y2",
    "h",
    "w",
    "l",
    "x",
    "y",
    "z",
    "ry",
    "score",
)


@dataclass(frozen=True)
class KittiObject:
    """One line of a label or result file.

    bbox      (x1, y1, x2, y2) pixels in image 2
    size      (h, w, l) metres
    location  (x, y, z) bottom centre in rectified camera 0, metres
    score     None in labels
    """

    type: str
    truncated: float
    occluded: int
    alpha: float
    bbox: tuple[float, float, float, float]
    size: tuple[float, float, float]
    location: tuple[float, float, float]
    ry: float
    score: float | None = None

    @property
    def height_2d(self) -> float:
        """Height of the 2D box in pixels."""
        return self.bbox[3] - self.bbox[1]


def parse_line(line: str, *, where: str = "line", scored: bool | None = None) -> KittiObject:
    """One line of a label (15 columns) or result (16 columns) file; further columns are not looked at.

    Exports write more columns than the devkit defines (nuScenes 16, CADC 18); its reader takes the first 15 (16).
    where   "file:number" put in front of messages
    scored  True demands a score, False looks at 15 columns, None takes a score when there is one
    Raises ValueError naming the column that is wrong.
    """
    fewest = 16 if scored else 15
    fields = split_fields(line, fewest)
    if len(fields) < fewest:
        wanted = "15 or 16" if scored is None else str(fewest)
        hint = "; a result line needs a score in column 16" if scored and len(fields) == 15 else ""
        raise ValueError(f"{where}: expected {wanted} columns, got {len(fields)}{hint}")
    fields = fields[: 15 if scored is False else 16]
    numbers: list[float] = []
    for name, text in zip(COLUMNS[1:], fields[1:]):
        try:
            value = float(text)
        except ValueError:
            raise ValueError(f"{where}: column '{name}' is not a number: {text!r}") from None
        if not math.isfinite(value):
            raise ValueError(f"{where}: column '{name}' is {text}; expected a finite number")
        numbers.append(value)
    return KittiObject(
        type=fields[0],
        truncated=numbers[0],
        occluded=int(numbers[1]),
        alpha=numbers[2],
        bbox=(numbers[3], numbers[4], numbers[5], numbers[6]),
        size=(numbers[7], numbers[8], numbers[9]),
        location=(numbers[10], numbers[11], numbers[12]),
        ry=numbers[13],
        score=numbers[14] if len(numbers) == 15 else None,
    )


def format_line(item: KittiObject) -> str:
    """The text of one line, without a newline: labels with 2 decimals as in KITTI, results (with a score) with 4."""
    digits = 2 if item.score is None else 4
    numbers = [item.alpha, *item.bbox, *item.size, *item.location, item.ry]
    text = " ".join(f"{value:.{digits}f}" for value in numbers)
    # Results carry "-1" for the two fields a detector does not estimate; labels keep two decimals.
    truncated = "-1" if item.truncated == -1 else f"{item.truncated:.2f}"
    line = f"{item.type} {truncated} {item.occluded} {text}"
    return line if item.score is None else f"{line} {item.score:.6f}"


def parse_lines(text: str, *, where: str = "text", scored: bool | None = None) -> list[KittiObject]:
    """All objects of a file's text; blank lines are skipped. Raises ValueError with the line number."""
    return [
        parse_line(line, where=f"{where}:{number}", scored=scored)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip()
    ]


def boxes_of(objects: Iterable[KittiObject]) -> Boxes3D:
    """Boxes3D (x y z h w l ry) of the objects, in order."""
    rows = [(*item.location, *item.size, item.ry) for item in objects]
    return Boxes3D(np.array(rows, dtype=np.float64).reshape(-1, 7))
