"""The values that travel through detection: a cloud with its camera, boxes, and boxes with class and score."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PointFrame:
    """A point cloud and the camera it is seen by.

    points      (N, 3 + C) float32; x forward, y left, z up in metres (LiDAR frame), then C columns (intensity first)
    T_cam_velo  (4, 4) float64, LiDAR frame -> rectified camera 0 (R0_rect * Tr_velo_to_cam); x right, y down, z forward
    P2          (3, 4) float64, rectified camera 0 -> image 2, pixels
    image_size  (height, width) of that image in pixels
    id          frame name, used in messages and to derive seeds
    """

    points: NDArray[np.float32]
    T_cam_velo: NDArray[np.float64]
    P2: NDArray[np.float64]
    image_size: tuple[int, int]
    id: str = ""

    def __post_init__(self) -> None:
        points = np.ascontiguousarray(self.points, dtype=np.float32)
        if points.ndim != 2 or points.shape[1] < 3:
            raise ValueError(f"points: expected (N, 3 or more) x y z ..., got shape {points.shape}")
        if not np.isfinite(points).all():
            bad = int((~np.isfinite(points)).any(axis=1).sum())
            raise ValueError(f"points: {bad} of {len(points)} points hold NaN or infinite values; drop them first")
        object.__setattr__(self, "points", points)
        for name, shape in (("T_cam_velo", (4, 4)), ("P2", (3, 4))):
            matrix = np.asarray(getattr(self, name), dtype=np.float64)
            if matrix.shape != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {matrix.shape}")
            object.__setattr__(self, name, matrix)


@dataclass(frozen=True)
class Boxes3D:
    """3D boxes in KITTI's rectified camera form.

    values  (N, 7) float64: x y z of the *bottom centre* (metres, camera 0, y down), h w l (metres),
            ry (radians about +y)
    """

    values: NDArray[np.float64]

    def __post_init__(self) -> None:
        values = np.ascontiguousarray(self.values, dtype=np.float64)
        if values.size == 0:
            values = values.reshape(0, 7)
        if values.ndim != 2 or values.shape[1] != 7:
            raise ValueError(f"boxes: expected (N, 7) x y z h w l ry, got shape {values.shape}")
        if not np.isfinite(values).all():
            raise ValueError("boxes: NaN or infinite values")
        object.__setattr__(self, "values", values)

    def __len__(self) -> int:
        return len(self.values)

    @classmethod
    def empty(cls) -> Boxes3D:
        """No boxes."""
        return cls(np.zeros((0, 7)))

    @property
    def bottom_centre(self) -> NDArray[np.float64]:
        """(N, 3) x y z in metres."""
        return self.values[:, 0:3]

    @property
    def size(self) -> NDArray[np.float64]:
        """(N, 3) height, width, length in metres."""
        return self.values[:, 3:6]

    @property
    def ry(self) -> NDArray[np.float64]:
        """(N,) rotation about the camera's y axis in radians; 0 faces +x."""
        return self.values[:, 6]


@dataclass(frozen=True)
class Detections:
    """Boxes with a class and a score each.

    boxes    Boxes3D of length N
    classes  N class names ("Car", "Pedestrian", "Cyclist", ...)
    scores   (N,) float64; any monotone score, raw logits allowed (KITTI AP uses only the order)
    """

    boxes: Boxes3D
    classes: tuple[str, ...]
    scores: NDArray[np.float64]

    def __post_init__(self) -> None:
        scores = np.asarray(self.scores, dtype=np.float64).reshape(-1)
        object.__setattr__(self, "classes", tuple(self.classes))
        object.__setattr__(self, "scores", scores)
        if not len(self.boxes) == len(self.classes) == len(scores):
            raise ValueError(
                f"detections: {len(self.boxes)} boxes, {len(self.classes)} classes and {len(scores)} scores differ"
            )
        if not np.isfinite(scores).all():
            raise ValueError("detections: NaN or infinite scores")

    def __len__(self) -> int:
        return len(self.boxes)

    @classmethod
    def empty(cls) -> Detections:
        """Nothing found."""
        return cls(Boxes3D.empty(), (), np.zeros(0))

    def select(self, keep: NDArray[Any] | Sequence[int]) -> Detections:
        """The detections of a boolean mask or an index list, in that order."""
        index = np.arange(len(self))[np.asarray(keep)] if len(self) else np.zeros(0, dtype=int)
        return Detections(Boxes3D(self.boxes.values[index]), tuple(self.classes[i] for i in index), self.scores[index])
