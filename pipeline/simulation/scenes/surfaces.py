"""What a triangle looks like: colour, texture, class and how it answers a LiDAR pulse.

Colours are linear RGB albedo in [0, 1]. Reflectance is the diffuse reflectance at the LiDAR's 905 nm, where leaves are
bright and dark paint and glass nearly vanish.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Colour = tuple[float, float, float]

# Cityscapes trainIds used by the scenes.
ROAD, SIDEWALK, BUILDING, WALL, FENCE, POLE, TRAFFIC_LIGHT, TRAFFIC_SIGN = range(8)
VEGETATION, TERRAIN, SKY, PERSON, RIDER, CAR, TRUCK, BUS, TRAIN, MOTORCYCLE, BICYCLE = range(8, 19)
NO_CLASS = 255


class Texture(IntEnum):
    """Procedural texture functions of `pipeline.simulation.shading`."""

    PLAIN = 0
    ASPHALT = 1
    PAVING = 2
    GRASS = 3
    PLASTER = 4
    BRICK = 5
    LEAVES = 6
    BARK = 7
    GLASS = 8
    PAINT = 9
    TILES = 10
    BOARDS = 11
    SOIL = 12
    CLOTH = 13
    STRIPES = 14
    BILLBOARD = 15


@dataclass(frozen=True)
class Surface:
    """One material.

    texture       which procedural pattern modulates `colour` towards `second`
    colour        main albedo, linear RGB
    second        albedo the pattern mixes in
    scale         size of the pattern in metres
    train_id      Cityscapes trainId
    reflectance   LiDAR reflectance in [0, 1]
    transmission  probability that a LiDAR pulse passes through (glass)
    dropout       probability that a pulse is lost for other reasons (mirrors, panes)
    gloss         strength of the sky's mirror image in the picture, [0, 1]
    smooth        True: shade with interpolated vertex normals
    """

    texture: Texture
    colour: Colour
    train_id: int
    reflectance: float
    second: Colour = (0.0, 0.0, 0.0)
    scale: float = 1.0
    transmission: float = 0.0
    dropout: float = 0.0
    gloss: float = 0.0
    smooth: bool = False

    def classed(self, train_id: int) -> Surface:
        """The same material on an object of another class."""
        return replace(self, train_id=train_id)


@dataclass(frozen=True)
class SurfaceTable:
    """Surfaces as columns, so that a hit is looked up by its surface number."""

    texture: NDArray[np.uint8]
    colour: NDArray[np.float32]
    second: NDArray[np.float32]
    scale: NDArray[np.float32]
    train_id: NDArray[np.uint8]
    reflectance: NDArray[np.float32]
    transmission: NDArray[np.float32]
    dropout: NDArray[np.float32]
    gloss: NDArray[np.float32]
    smooth: NDArray[np.bool_]

    @classmethod
    def of(cls, surfaces: list[Surface]) -> SurfaceTable:
        """Columns of a list of surfaces, in order."""
        return cls(
            texture=np.array([s.texture for s in surfaces], dtype=np.uint8),
            colour=np.array([s.colour for s in surfaces], dtype=np.float32).reshape(-1, 3),
            second=np.array([s.second for s in surfaces], dtype=np.float32).reshape(-1, 3),
            scale=np.array([s.scale for s in surfaces], dtype=np.float32),
            train_id=np.array([s.train_id for s in surfaces], dtype=np.uint8),
            reflectance=np.array([s.reflectance for s in surfaces], dtype=np.float32),
            transmission=np.array([s.transmission for s in surfaces], dtype=np.float32),
            dropout=np.array([s.dropout for s in surfaces], dtype=np.float32),
            gloss=np.array([s.gloss for s in surfaces], dtype=np.float32),
            smooth=np.array([s.smooth for s in surfaces], dtype=bool),
        )


def vary(rng: np.random.Generator, colour: Colour, amount: float = 0.15) -> Colour:
    """A colour brighter or darker by up to `amount` (relative), with a third of that in hue."""
    value = np.array(colour) * (1 + rng.uniform(-amount, amount)) * (1 + rng.uniform(-amount, amount, 3) / 3)
    red, green, blue = np.clip(value, 0.004, 0.95)
    return float(red), float(green), float(blue)


GLASS_CAR = Surface(
    Texture.GLASS, (0.012, 0.014, 0.015), CAR, 0.06, transmission=0.45, dropout=0.75, gloss=0.85, smooth=True
)
PANE = Surface(Texture.GLASS, (0.02, 0.024, 0.028), BUILDING, 0.10, dropout=0.3, gloss=0.7)
TYRE = Surface(Texture.PLAIN, (0.012, 0.012, 0.012), CAR, 0.05, dropout=0.15)
RIM = Surface(Texture.PLAIN, (0.28, 0.28, 0.29), CAR, 0.35, gloss=0.25)
PLASTIC_DARK = Surface(Texture.PLAIN, (0.018, 0.018, 0.02), CAR, 0.08)
INTERIOR = Surface(Texture.PLAIN, (0.02, 0.02, 0.021), CAR, 0.16)
HEADLAMP = Surface(Texture.PLAIN, (0.55, 0.56, 0.58), CAR, 0.5, gloss=0.5, dropout=0.2)
TAIL_LAMP = Surface(Texture.PLAIN, (0.32, 0.015, 0.012), CAR, 0.55, gloss=0.2)
PLATE = Surface(Texture.PLAIN, (0.65, 0.65, 0.62), CAR, 0.95)
METAL = Surface(Texture.PLAIN, (0.22, 0.23, 0.24), POLE, 0.3, gloss=0.08)
BARK = Surface(Texture.BARK, (0.075, 0.055, 0.04), VEGETATION, 0.28, second=(0.02, 0.015, 0.012), scale=0.08)
ASPHALT = Surface(Texture.ASPHALT, (0.17, 0.168, 0.165), ROAD, 0.24, second=(0.10, 0.10, 0.102))
MARKING = Surface(Texture.ASPHALT, (0.56, 0.56, 0.54), ROAD, 0.62, second=(0.38, 0.38, 0.37))
KERB = Surface(Texture.PLAIN, (0.32, 0.31, 0.30), SIDEWALK, 0.32, second=(0.2, 0.2, 0.19), scale=0.4)
PAVING = Surface(Texture.PAVING, (0.27, 0.26, 0.245), SIDEWALK, 0.3, second=(0.14, 0.135, 0.13), scale=0.3)
GRASS = Surface(Texture.GRASS, (0.075, 0.11, 0.03), TERRAIN, 0.38, second=(0.16, 0.15, 0.065))
SOIL = Surface(Texture.SOIL, (0.17, 0.135, 0.095), TERRAIN, 0.3, second=(0.09, 0.07, 0.05))
UNDERSIDE = Surface(Texture.PLAIN, (0.02, 0.02, 0.021), ROAD, 0.2)
