"""Where objects are in the image: labelled boxes, result files, the Frustum PointNets lists of 2D detections, masks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from detection.frustum.coding import CLASSES
from detection.kitti_format import KittiObject

Box = tuple[float, float, float, float]

# Class numbers of the published lists ("rgb_detections").
LISTED = {1: "Pedestrian", 2: "Car", 3: "Cyclist"}


@dataclass(frozen=True, eq=False)
class Region:
    """A part of the image that shows one object.

    type    "Car", "Pedestrian" or "Cyclist"
    bbox    (x1, y1, x2, y2) pixels; it may reach beyond the image
    score   of the 2D detector, None for a labelled box
    pixels  (H, W) bool of a mask, None for the whole box
    """

    type: str
    bbox: Box
    score: float | None = None
    pixels: NDArray[np.bool_] | None = None


def object_regions(objects: Iterable[KittiObject]) -> list[Region]:
    """The 2D boxes of labels or results, in order; types that Frustum PointNet does not know are left out."""
    return [Region(item.type, item.bbox, item.score) for item in objects if item.type in CLASSES]


def parse_detection_list(text: str, *, where: str = "text") -> dict[str, list[Region]]:
    """Regions by frame of a published list: lines "image_path class score x1 y1 x2 y2", frame = file name of the image.

    Nothing is clipped and no score is too low: average precision needs them all. Blank lines are skipped.
    Raises ValueError naming the line that is wrong.
    """
    found: dict[str, list[Region]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip():
            frame, region = _listed(line.split(), f"{where}:{number}")
            found.setdefault(frame, []).append(region)
    return found


def _listed(fields: list[str], where: str) -> tuple[str, Region]:
    if len(fields) != 7:
        raise ValueError(f"{where}: expected 7 columns (image class score x1 y1 x2 y2), got {len(fields)}")
    try:
        kind, score, *box = (float(field) for field in fields[1:])
    except ValueError as error:
        raise ValueError(f"{where}: not a number: {error}") from None
    if kind not in LISTED:
        raise ValueError(f"{where}: class {fields[1]}; expected 1 (Pedestrian), 2 (Car) or 3 (Cyclist)")
    if not all(map(math.isfinite, (score, *box))) or box[2] <= box[0] or box[3] <= box[1]:
        raise ValueError(f"{where}: expected a finite score and x1 < x2, y1 < y2, got {' '.join(fields[2:])}")
    return PurePosixPath(fields[0]).stem, Region(LISTED[int(kind)], (box[0], box[1], box[2], box[3]), score)


def mask_regions(classes: NDArray[np.integer], names: Mapping[int, str], least_pixels: int = 20) -> list[Region]:
    """One region for every connected part of a class map (H, W); `names` says which values are which of `CLASSES`.

    Neighbours of all eight sides connect. The score is 1: a map has none.
    """
    from scipy import ndimage

    found = []
    for value, name in names.items():
        parts, count = ndimage.label(np.asarray(classes) == value, structure=np.ones((3, 3)))
        for index, area in enumerate(ndimage.find_objects(parts, count), start=1):
            pixels = parts == index
            if int(pixels.sum()) >= least_pixels:
                rows, columns = area
                box = (float(columns.start), float(rows.start), float(columns.stop), float(rows.stop))
                found.append(Region(name, box, 1.0, pixels))
    return found


def instance_regions(instances: NDArray[np.integer], types: Mapping[int, str]) -> list[Region]:
    """One region for every instance of a map (H, W) whose id has a type among `CLASSES`; the score is 1."""
    found = []
    for number, name in types.items():
        pixels = np.asarray(instances) == number
        if name in CLASSES and pixels.any():
            rows, columns = np.flatnonzero(pixels.any(axis=1)), np.flatnonzero(pixels.any(axis=0))
            box = (float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1))
            found.append(Region(name, box, 1.0, pixels))
    return found
