"""Synthetic frames and data sets: one seed, the same bytes for any number of workers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from auglidar_base.errors import SettingsError
from detection.kitti_format import KittiObject
from pipeline.geometry.calibration import Calibration
from pipeline.simulation.labels import ObjectTruth, kitti_labels, measure
from pipeline.simulation.lidar import scan, sensor
from pipeline.simulation.render import View, render
from pipeline.simulation.rig import LIDAR_HEIGHT, draw_rig
from pipeline.simulation.scenes.layouts import LAYOUTS, draw_scene
from pipeline.simulation.scenes.scene import Scene
from pipeline.simulation.tracing import Tracer

FILE_LAYOUTS = ("kitti", "kitti_depth", "vkitti2")


@dataclass(frozen=True)
class SynthSettings:
    """What to generate.

    frames   how many
    seed     of everything random
    layout   of the files: "kitti" (object set), "kitti_depth" (depth completion set) or "vkitti2"
    size     (height, width) in pixels, or None for KITTI's own five cameras
    rows     LiDAR rows: 64, 32, 16 or 8
    stereo   render the right camera too (KITTI's image_3)
    streets  scene layouts to draw from, see `scenes.layouts.LAYOUTS`
    """

    frames: int = 20
    seed: int = 0
    layout: str = "kitti"
    size: tuple[int, int] | None = None
    rows: int = 64
    stereo: bool = False
    streets: tuple[str, ...] = tuple(LAYOUTS)

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise SettingsError(f"frames: expected at least 1, got {self.frames}")
        if self.layout not in FILE_LAYOUTS:
            raise SettingsError(f"layout: expected one of {', '.join(FILE_LAYOUTS)}, got {self.layout!r}")
        unknown = [name for name in self.streets if name not in LAYOUTS]
        if unknown or not self.streets:
            raise SettingsError(f"streets: expected names among {', '.join(LAYOUTS)}, got {unknown or 'none'}")
        if self.size is not None and (len(self.size) != 2 or min(self.size) < 16):
            raise SettingsError(f"size: expected (height, width) of at least 16 pixels, got {self.size}")
        sensor(self.rows)


@dataclass(frozen=True, eq=False)
class SyntheticFrame:
    """One frame with everything known about it.

    left, right   views of cameras 2 and 3 (right is None without stereo)
    points        (N, 4) float32 x y z intensity, LiDAR frame
    labels        KITTI objects and DontCare regions; truths: exact values of everything in view
    T_world_cam   (4, 4) pose of rectified camera 0; street: the scene's layout
    """

    id: str
    left: View
    right: View | None
    points: NDArray[np.float32]
    calibration: Calibration
    labels: list[KittiObject]
    truths: list[ObjectTruth]
    T_world_cam: NDArray[np.float64]
    street: str

    @property
    def image(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB of the left colour camera."""
        return self.left.image

    @property
    def depth(self) -> NDArray[np.float32]:
        """(H, W) float32 dense depth in metres, 0 = sky."""
        return self.left.depth

    @property
    def semantics(self) -> NDArray[np.uint8]:
        """(H, W) uint8 Cityscapes trainIds."""
        return self.left.semantics

    @property
    def instances(self) -> NDArray[np.int32]:
        """(H, W) int32, 0 = none."""
        return self.left.instances


def frame_rng(settings: SynthSettings, index: int, purpose: int) -> np.random.Generator:
    """The random numbers of one purpose (scene, rig, camera, LiDAR) in one frame."""
    return np.random.default_rng([settings.seed, index, purpose])


def simulate_frame(settings: SynthSettings, index: int) -> SyntheticFrame:
    """Frame `index` of the data set: a street of its own, photographed and scanned. The same for the same arguments."""
    scene = draw_scene(frame_rng(settings, index, 0), settings.streets)
    calibration, size = draw_rig(frame_rng(settings, index, 1), settings.size)
    return observe(scene, 0.0, calibration, size, settings, index)


def observe(
    scene: Scene, time: float, calibration: Calibration, size: tuple[int, int], settings: SynthSettings, index: int
) -> SyntheticFrame:
    """The scene at `time` seconds as cameras of `size` (height, width) and LiDAR record it; `index` seeds the noise."""
    tracer = Tracer(scene.triangles(time))
    T_world_velo = scene.T_world_velo(time, LIDAR_HEIGHT)
    T_world_cam = T_world_velo @ calibration.T_velo_cam
    camera = frame_rng(settings, index, 2)
    left = render(tracer, scene.light, calibration.P2, T_world_cam, size, camera)
    right = None
    if settings.stereo and calibration.P3 is not None:
        right = render(tracer, scene.light, calibration.P3, T_world_cam, size, camera)
    truths = measure(
        scene, time, calibration.P2, np.asarray(np.linalg.inv(T_world_cam), dtype=np.float64), left.instances
    )
    return SyntheticFrame(
        id=f"{index:06d}",
        left=left,
        right=right,
        points=scan(tracer, sensor(settings.rows), T_world_velo, frame_rng(settings, index, 3)),
        calibration=calibration,
        labels=kitti_labels(truths, size),
        truths=truths,
        T_world_cam=T_world_cam,
        street=scene.layout,
    )
