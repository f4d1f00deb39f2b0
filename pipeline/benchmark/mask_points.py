"""Masks on real frames without label maps: do the LiDAR points under a mask lie in the labelled 3D boxes?

KITTI's object frames have boxes and no masks. A box holds little but its object, so its points say where the object's
pixels are. A mask that leaks over an object's outline calls points of the background behind it vehicles, which is just
what harms an augmented cloud.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detection.kitti_format import KittiObject, boxes_of
from detection.ops.pooling import points_in_boxes
from pipeline.base.errors import UsageError
from pipeline.data import Dataset, Frame
from pipeline.geometry.in_view import lidar_pixels
from pipeline.geometry.rings import split_rings
from pipeline.geometry.visibility import visible_points
from pipeline.semantics.conventions import GROUPS
from pipeline.semantics.sources import SemanticsSource

Mask = NDArray[np.bool_]

# Groups of classes -> KITTI's types of box.
TYPES = {
    "vehicles": ("Car", "Van", "Truck", "Tram"),
    "people": ("Pedestrian", "Person_sitting", "Cyclist"),
}
# A box reaches down to the road, whose points in it are not the object's. Metres.
ABOVE_ROAD = 0.2


@dataclass(frozen=True)
class PointCounts:
    """LiDAR points in a mask and a box, in the mask, in a box."""

    both: int = 0
    masked: int = 0
    boxed: int = 0

    def __add__(self, other: PointCounts) -> PointCounts:
        return PointCounts(self.both + other.both, self.masked + other.masked, self.boxed + other.boxed)

    @property
    def shares(self) -> dict[str, float | None]:
        """Recall, precision, and intersection over union; None of nothing."""
        either = self.masked + self.boxed - self.both
        wholes = {"recall": self.boxed, "precision": self.masked, "iou": either}
        return {name: self.both / whole if whole else None for name, whole in wholes.items()}


def mask_scores(
    dataset: Dataset, sources: Mapping[str, SemanticsSource], progress: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Counts and shares over all frames, an entry per source (by its name) and group.

    Raises UsageError for a source of scores ("soft"), which do not tell vehicles from people.
    """
    found = []
    for name, masks in sources.items():
        sums = dict.fromkeys(GROUPS, PointCounts())
        for frame in dataset:
            semantics = masks.semantics(frame)
            if semantics.dtype != np.uint8:
                raise UsageError(f"mask {name!r}: expected a source of labels, not of scores")
            for group, counts in count_points(frame, semantics.astype(np.uint8, copy=False)).items():
                sums[group] += counts
            progress(f"mask {name} {frame.id}")
        found += [{"mask": name, "group": group, **vars(sums[group]), **sums[group].shares} for group in GROUPS]
    return found


def count_points(frame: Frame, semantics: NDArray[np.uint8]) -> dict[str, PointCounts]:
    """Counts of a frame with labels, by group.

    Only returns that the camera sees count, and none in a DontCare region or in the lowest 0.2 m of a box.
    """
    points = frame.points
    seen = points[visible_points(points, split_rings(points), frame.calibration, frame.image_size)]
    camera = frame.calibration.velo_to_cam(seen)
    row, column = np.divmod(lidar_pixels(seen, frame.calibration, frame.image_size), frame.image_size[1])
    classes, left_out = semantics[row, column], _in_regions(column, row, frame.labels)
    counts = {}
    for group, train_ids in GROUPS.items():
        boxes = boxes_of(item for item in frame.labels if item.type in TYPES[group]).values
        inside = points_in_boxes(camera, boxes).any(axis=0)
        boxes[:, 1] -= ABOVE_ROAD
        boxes[:, 3] -= ABOVE_ROAD
        boxed = points_in_boxes(camera, boxes).any(axis=0)
        counted = ~left_out & ~(inside & ~boxed)
        masked = np.isin(classes, train_ids) & counted
        boxed &= counted
        counts[group] = PointCounts(int((masked & boxed).sum()), int(masked.sum()), int(boxed.sum()))
    return counts


def _in_regions(column: NDArray[np.int_], row: NDArray[np.int_], labels: list[KittiObject]) -> Mask:
    """(N,) True for pixels in a DontCare region."""
    inside = np.zeros(len(column), dtype=bool)
    for item in labels:
        if item.type == "DontCare":
            left, top, right, bottom = item.bbox
            inside |= (column >= left) & (column <= right) & (row >= top) & (row <= bottom)
    return inside
