"""One frame of any data set; each part is read when it is first asked for, and only then.

Readers give a `Frame` one loader per part they have. Asking for a part without a loader raises `MissingPart`; damage in
a file raises `DataError` from the loader. Nothing is cached beyond the frame object: a batch keeps one frame in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detection.kitti_format import KittiObject
from detection.types import PointFrame
from pipeline.base.errors import MissingPart
from pipeline.data.cloud_columns import CloudForm
from pipeline.geometry.calibration import Calibration

PARTS = (
    "image",
    "image_size",
    "points",
    "calibration",
    "labels",
    "sparse_depth",
    "target_depth",
    "semantics",
    "instances",
)


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame and the loaders of its parts.

    id       unique name within the data set (KITTI: "000123"; others may contain "/")
    loaders  part name -> function without arguments
    where    folder or file named in messages
    """

    id: str
    loaders: Mapping[str, Callable[[], Any]] = field(repr=False)
    where: str = ""

    def has(self, part: str) -> bool:
        """True when the data set offers this part for this frame (its file may still turn out to be damaged)."""
        return part in self.loaders

    def files(self, part: str) -> tuple[Path, ...]:
        """The files `part` is read from: the paths among its loader's arguments (readers use functools.partial), and
        among those of a loader that is an argument itself.

        Empty when the loader names none; the runner then recognises a changed part by its content.
        """
        return _paths(self.loaders.get(part))

    def sources(self, part: str) -> tuple[str, ...]:
        """The parts that `part` is read from: itself when it is stored, else those it is derived from."""
        if part == "image_size" and not self.has(part):
            return ("image",)
        if part == "sparse_depth" and not self.has(part):
            return ("points", "calibration", *self.sources("image_size"))
        return (part,)

    def forms(self, part: str) -> tuple[str, ...]:
        """How the files of `part` are read: its loader's other arguments, such as the columns of a cloud."""
        loader = self.loaders.get(part)
        arguments = (*loader.args, *loader.keywords.values()) if isinstance(loader, partial) else ()
        return tuple(repr(argument) for argument in arguments if isinstance(argument, (int, str, CloudForm)))

    def _load(self, part: str) -> Any:
        if part not in self.loaders:
            have = ", ".join(name for name in PARTS if name in self.loaders) or "nothing"
            raise MissingPart(f"{self.where} frame {self.id}".strip(), part, have)
        return self.loaders[part]()

    @cached_property
    def image(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB."""
        return np.asarray(self._load("image"))

    @cached_property
    def image_size(self) -> tuple[int, int]:
        """(height, width) in pixels; from the image's header when the reader can, else from the image."""
        if "image_size" in self.loaders:
            height, width = self.loaders["image_size"]()
            return int(height), int(width)
        return self.image.shape[0], self.image.shape[1]

    @cached_property
    def points(self) -> NDArray[np.float32]:
        """(N, 4) float32 x y z intensity in the LiDAR frame, metres."""
        return np.asarray(self._load("points"))

    @cached_property
    def calibration(self) -> Calibration:
        """Camera and LiDAR calibration of this frame."""
        calibration: Calibration = self._load("calibration")
        return calibration

    @cached_property
    def labels(self) -> list[KittiObject]:
        """Labelled objects in KITTI form, DontCare included."""
        labels: list[KittiObject] = self._load("labels")
        return labels

    @cached_property
    def sparse_depth(self) -> NDArray[np.float32]:
        """(H, W) float32 metres, 0 = none: stored, or the z-buffered projection of `points`."""
        if "sparse_depth" in self.loaders:
            return np.asarray(self.loaders["sparse_depth"]())
        from pipeline.geometry.project import project_points

        return project_points(self.points, self.calibration, self.image_size)

    @cached_property
    def target_depth(self) -> NDArray[np.float32]:
        """(H, W) float32 metres, 0 = none: ground truth depth."""
        return np.asarray(self._load("target_depth"))

    @cached_property
    def semantics(self) -> NDArray[np.uint8]:
        """(H, W) uint8 Cityscapes trainIds, 255 = none."""
        return np.asarray(self._load("semantics"))

    @cached_property
    def instances(self) -> NDArray[np.int32]:
        """(H, W) int32, 0 = none, value = track or object number + 1."""
        return np.asarray(self._load("instances"))

    @property
    def point_frame(self) -> PointFrame:
        """The raw cloud with its camera, as `detection` takes it."""
        return PointFrame(self.points, self.calibration.T_cam_velo, self.calibration.P2, self.image_size, self.id)


def _paths(loader: object) -> tuple[Path, ...]:
    """The paths among the arguments of a functools.partial."""
    if not isinstance(loader, partial):
        return ()
    arguments = (*loader.args, *loader.keywords.values())
    return tuple(
        path for argument in arguments for path in ((argument,) if isinstance(argument, Path) else _paths(argument))
    )
