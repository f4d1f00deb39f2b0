"""One test frame as a run saw it: cloud from above, true and found boxes; kept in the run's folder for Fig. 5.8."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from auglidar_base.atomic import write_bytes
from detection.boxes import corners
from detection.kitti_format import KittiObject, boxes_of
from pipeline.base.errors import DataError

if TYPE_CHECKING:
    from pipeline.data import Frame
    from pipeline.experiments.cloud_cache import CloudCache

SCORE = 0.3
_WIDTH = 828  # of the stored picture, pixels
_POINTS = 12_000


@dataclass(frozen=True)
class Example:
    """image (H, W, 3) RGB; points (N, 3) x forward, y left, source; truth and found (B, 4, 2) outlines x y, metres."""

    image: NDArray[np.uint8]
    points: NDArray[np.float32]
    truth: NDArray[np.float32]
    found: NDArray[np.float32]


def richest(labels: dict[str, list[KittiObject]]) -> str:
    """Id of the frame with most cars; the first of several."""
    return max(labels, key=lambda frame_id: (sum(item.type == "Car" for item in labels[frame_id]), frame_id))


def outlines(frame: Frame, objects: list[KittiObject]) -> NDArray[np.float32]:
    """(B, 4, 2) corners of the boxes' bottoms in the LiDAR frame, metres."""
    solid = [item for item in objects if min(item.size) > 0]
    if not solid:
        return np.zeros((0, 4, 2), np.float32)
    bottoms = corners(boxes_of(solid))[:, :4]
    return np.stack([frame.calibration.cam_to_velo(box)[:, :2] for box in bottoms]).astype(np.float32)


def write_example(
    path: Path, clouds: CloudCache, labels: dict[str, list[KittiObject]], found: dict[str, list[KittiObject]]
) -> None:
    """Writes the frame with most cars of a run."""
    frame = clouds.dataset[richest(labels)]
    points = clouds.read(frame.id).points
    if len(points) > _POINTS:
        points = points[np.sort(np.random.default_rng(0).choice(len(points), _POINTS, replace=False))]
    height, width = frame.image_size
    image = cv2.resize(frame.image, (_WIDTH, round(_WIDTH * height / width)), interpolation=cv2.INTER_AREA)
    sure = [item for item in found[frame.id] if (item.score or 0.0) > SCORE]
    true = [item for item in labels[frame.id] if item.type in ("Car", "Van")]
    parts: dict[str, Any] = {
        "image": image,
        "points": points[:, [0, 1, 4]],
        "truth": outlines(frame, true),
        "found": outlines(frame, sure),
    }
    buffer = io.BytesIO()
    np.savez(buffer, **parts)
    write_bytes(path, buffer.getvalue())


def read_example(path: Path) -> Example:
    """What `write_example` wrote. DataError when it is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as parts:
            return Example(parts["image"], parts["points"], parts["truth"], parts["found"])
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise DataError(path, "the example frame of a run", str(error), "remove the run's folder") from None
