"""A scene: what stands still, what is labelled, where the recording car is, and the light."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.scenes import surfaces as S
from pipeline.simulation.scenes.ground import Ground
from pipeline.simulation.scenes.mesh import Part, TriangleScene, assemble, quad
from pipeline.simulation.scenes.vehicles import Model


@dataclass(frozen=True)
class Placed:
    """A labelled thing: road coordinates at time 0, heading relative to the road, speed along its heading in m/s."""

    model: Model
    s: float
    d: float
    yaw: float
    speed: float = 0.0

    def pose(self, ground: Ground, time: float) -> NDArray[np.float64]:
        """(4, 4) T_world_object at `time` seconds."""
        travelled = self.speed * time
        s, d = self.s + travelled * np.cos(self.yaw), self.d + travelled * np.sin(self.yaw)
        return ground.place(s, d, self.yaw, tilted=True)


@dataclass(frozen=True)
class Ego:
    """The recording car: road coordinates at time 0, heading relative to the road in radians, speed in m/s."""

    d: float
    yaw: float
    speed: float


@dataclass(frozen=True)
class Light:
    """Sun and sky, and how the camera exposes them.

    sun        unit vector towards the sun
    direct     strength of sun light (0 when overcast), ambient: of sky light
    sky        colour at the zenith, horizon: colour above the horizon, clouds: share of the sky they cover
    exposure   stops around the automatic exposure; tint: white balance gains of red and blue
    """

    sun: tuple[float, float, float]
    direct: float
    ambient: float
    sky: S.Colour
    horizon: S.Colour
    clouds: float
    exposure: float
    tint: tuple[float, float]


def draw_light(rng: np.random.Generator) -> Light:
    """A day: three in four sunny with low to high sun, the others overcast."""
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(18, 62))
    sun = (
        float(np.cos(azimuth) * np.cos(elevation)),
        float(np.sin(azimuth) * np.cos(elevation)),
        float(np.sin(elevation)),
    )
    sunny = rng.random() < 0.75
    blue = S.vary(rng, (0.28, 0.50, 0.92), 0.2)
    return Light(
        sun=sun,
        direct=float(rng.uniform(1.6, 2.6)) if sunny else 0.0,
        ambient=float(rng.uniform(0.45, 0.8)) if sunny else float(rng.uniform(0.9, 1.2)),
        sky=blue if sunny else (0.85, 0.88, 0.92),
        horizon=(0.85, 0.92, 1.0) if sunny else (0.95, 0.97, 1.0),
        clouds=float(rng.uniform(0, 0.8)) if sunny else 0.95,
        exposure=float(np.clip(rng.normal(-0.05, 0.4), -0.7, 0.9)),
        tint=(float(rng.normal(1.0, 0.04)), float(rng.normal(1.0, 0.05))),
    )


@dataclass(frozen=True)
class Scene:
    """Everything of one street.

    objects[k] has instance number k + 1 in every picture of the scene.
    """

    ground: Ground
    static: list[Part]
    objects: list[Placed]
    ego: Ego
    light: Light
    layout: str = field(default="")

    def object_parts(self, index: int, time: float) -> list[Part]:
        """Parts of one object in the world at `time`."""
        item = self.objects[index]
        return [part.moved(matrix) for matrix in (item.pose(self.ground, time),) for part in item.model.parts]

    def triangles(self, time: float) -> TriangleScene:
        """The whole scene at `time` seconds as triangles; a dark contact patch lies under every vehicle."""
        groups: list[tuple[int, list[Part]]] = [(0, self.static)]
        for index, item in enumerate(self.objects):
            groups.append((index + 1, self.object_parts(index, time)))
            if item.model.label in ("Car", "Van", "Truck"):
                groups.append((0, [contact_patch(item, item.pose(self.ground, time))]))
        return assemble(groups)

    def T_world_velo(self, time: float, mount_height: float) -> NDArray[np.float64]:
        """(4, 4) pose of the LiDAR: above the road by `mount_height`, tilted with the road."""
        seat = self.ground.place(self.ego.speed * time, self.ego.d, self.ego.yaw, tilted=True)
        lift = np.eye(4)
        lift[2, 3] = mount_height
        return np.asarray(seat @ lift)


def contact_patch(item: Placed, matrix: NDArray[np.float64]) -> Part:
    """The sunless ground under a vehicle, a few millimetres above the road."""
    length, width = 0.46 * item.model.size[0], 0.46 * item.model.size[1]
    corners = [(-length, -width, 0.012), (length, -width, 0.012), (length, width, 0.012), (-length, width, 0.012)]
    return quad(corners, S.UNDERSIDE).moved(matrix)
