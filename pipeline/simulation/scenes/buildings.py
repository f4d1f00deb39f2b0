"""Houses, blocks, halls and noise barriers with windows, doors and roofs."""

from __future__ import annotations

import numpy as np

from pipeline.simulation.scenes import surfaces as S
from pipeline.simulation.scenes.mesh import Part, box, boxes, quad
from pipeline.simulation.scenes.surfaces import Surface, Texture

_FACADES: tuple[S.Colour, ...] = (
    (0.62, 0.60, 0.55), (0.55, 0.46, 0.30), (0.48, 0.33, 0.24), (0.40, 0.40, 0.39), (0.60, 0.53, 0.42),
    (0.30, 0.34, 0.38), (0.5, 0.5, 0.52),
)  # fmt: skip


def _facade(rng: np.random.Generator) -> Surface:
    if rng.random() < 0.2:
        return Surface(
            Texture.BRICK, S.vary(rng, (0.22, 0.09, 0.055), 0.3), S.BUILDING, 0.35, second=(0.3, 0.27, 0.24), scale=0.25
        )
    colour = S.vary(rng, _FACADES[rng.integers(len(_FACADES))], 0.25)
    darker = (0.6 * colour[0], 0.6 * colour[1], 0.6 * colour[2])
    return Surface(Texture.PLASTER, colour, S.BUILDING, 0.5, second=darker, scale=2.0)


def _windows(rng: np.random.Generator, span: float, height: float, offset: float) -> list[Part]:
    """Framed panes of one facade along x at y = `offset`, storey by storey, and a door."""
    storey, step = float(rng.uniform(2.7, 3.2)), float(rng.uniform(2.0, 3.6))
    wide, tall = float(rng.uniform(0.8, min(1.7, step - 0.5))), float(rng.uniform(1.1, 1.7))
    columns = np.arange(-span / 2 + step / 2, span / 2 - step / 3, step)
    levels = np.arange(0.9, height - tall - 0.2, storey)
    if not len(columns) or not len(levels):
        return []
    x, z = (axis.ravel() for axis in np.meshgrid(columns, levels))
    keep = rng.random(len(x)) < 0.93
    x, z = x[keep], z[keep]
    frame = Surface(
        Texture.PLAIN,
        S.vary(rng, (0.6, 0.6, 0.58) if rng.random() < 0.7 else (0.1, 0.06, 0.04), 0.2),
        S.BUILDING,
        0.5,
        scale=0.5,
    )
    sunk = np.array([0, 0, 0.08])
    at = np.column_stack([x, np.full(len(x), offset), z])
    parts = [boxes(at, (wide + 0.16, 0.08, tall + 0.16), frame), boxes(at + sunk, (wide, 0.1, tall), S.PANE)]
    parts.append(boxes(at + sunk, (0.05, 0.12, tall), frame))
    if rng.random() < 0.3:
        shutter = Surface(
            Texture.BOARDS,
            S.vary(rng, (0.08, 0.11, 0.07), 0.5),
            S.BUILDING,
            0.35,
            second=(0.02, 0.02, 0.02),
            scale=0.08,
        )
        beside = np.array([wide / 2 + 0.3, 0, 0])
        parts += [boxes(at + side * beside, (0.42, 0.06, tall + 0.1), shutter) for side in (-1, 1)]
    door = Surface(
        Texture.BOARDS, S.vary(rng, (0.12, 0.06, 0.03), 0.5), S.BUILDING, 0.3, second=(0.04, 0.02, 0.01), scale=0.3
    )
    parts.append(box(1.0, 0.12, 2.1, door).at(float(rng.uniform(-0.3, 0.3)) * span, offset))
    return parts


def build_house(rng: np.random.Generator, length: float, depth: float, height: float) -> list[Part]:
    """A house of this footprint with its front at y = 0 facing -y; gable or flat roof."""
    facade = _facade(rng)
    parts = [box(length, depth, height + 2.0, facade, -2.0).at(0, depth / 2)]
    plinth = Surface(
        Texture.PLASTER, S.vary(rng, (0.25, 0.24, 0.22), 0.3), S.BUILDING, 0.35, second=(0.15, 0.15, 0.14), scale=1.0
    )
    parts.append(box(length + 0.08, depth + 0.08, 2.5, plinth, -2.0).at(0, depth / 2))
    parts += _windows(rng, length, height, -0.01)
    for side in (-1, 1):
        parts += [
            part.at(side * (length / 2 + 0.01), depth / 2, 0, side * np.pi / 2)
            for part in _windows(rng, depth, height, 0.0)
        ]
    if rng.random() < 0.7:
        return parts + _gable(rng, length, depth, height, facade)
    rim = Surface(Texture.PLAIN, S.vary(rng, (0.2, 0.2, 0.2), 0.4), S.BUILDING, 0.3, scale=0.5)
    return [*parts, box(length + 0.5, depth + 0.5, 0.35, rim, height).at(0, depth / 2)]


def _gable(rng: np.random.Generator, length: float, depth: float, height: float, facade: Surface) -> list[Part]:
    """A pitched roof with its ridge along x, gable walls, sometimes dormers and a chimney."""
    tiles = Surface(
        Texture.TILES,
        S.vary(rng, (0.26, 0.09, 0.055) if rng.random() < 0.65 else (0.07, 0.065, 0.07), 0.3),
        S.BUILDING,
        0.35,
        second=(0.10, 0.05, 0.04),
        scale=0.3,
    )
    rise, a, over = depth / 2 * float(rng.uniform(0.55, 1.0)), length / 2, 0.45
    ridge = height + rise
    slope = rise / (depth / 2) * over
    parts = [
        quad(
            [
                (-a - over, -over, height - slope),
                (a + over, -over, height - slope),
                (a + over, depth / 2, ridge),
                (-a - over, depth / 2, ridge),
            ],
            tiles,
        ),
        quad(
            [
                (-a - over, depth + over, height - slope),
                (-a - over, depth / 2, ridge),
                (a + over, depth / 2, ridge),
                (a + over, depth + over, height - slope),
            ],
            tiles,
        ),
    ]
    for side in (-1, 1):
        peak = np.array(
            [[side * a, 0, height], [side * a, depth, height], [side * a, depth / 2, ridge - 0.05]], dtype=np.float64
        )
        parts.append(Part(peak, np.array([[0, 1, 2]]), facade))
    if rng.random() < 0.6:
        brick = Surface(Texture.BRICK, (0.2, 0.08, 0.05), S.BUILDING, 0.35, second=(0.25, 0.23, 0.2), scale=0.25)
        parts.append(box(0.6, 0.6, 1.6, brick, ridge - 0.8).at(float(rng.uniform(-0.35, 0.35)) * length, depth * 0.55))
    if rng.random() < 0.4:
        where = float(rng.uniform(-0.25, 0.25)) * length
        parts += [
            box(1.6, 1.5, 1.3, facade, height + 0.2).at(where, 0.9),
            box(1.0, 0.1, 0.9, S.PANE, height + 0.4).at(where, 0.12),
        ]
    return parts


def build_hall(rng: np.random.Generator, length: float, depth: float, height: float) -> list[Part]:
    """A plain hall or shop with its front at y = 0: sheet metal, a band of glass, a billboard."""
    sheet = Surface(
        Texture.BOARDS, S.vary(rng, (0.4, 0.41, 0.42), 0.5), S.BUILDING, 0.45, second=(0.2, 0.2, 0.21), scale=0.3
    )
    parts = [box(length, depth, height + 2, sheet, -2.0).at(0, depth / 2)]
    if rng.random() < 0.6:
        parts.append(box(0.7 * length, 0.1, 2.2, S.PANE, 0.4).at(0, -0.02))
    if rng.random() < 0.6:
        board = Surface(
            Texture.BILLBOARD,
            S.vary(rng, (0.06, 0.1, 0.3), 0.8),
            S.BUILDING,
            0.5,
            second=S.vary(rng, (0.6, 0.55, 0.4), 0.5),
            scale=2.0,
        )
        parts.append(box(0.5 * length, 0.12, 0.3 * height, board, 0.62 * height).at(0.1 * length, -0.03))
    return parts


def noise_barrier(rng: np.random.Generator, length: float) -> list[Part]:
    """A motorway noise wall along x."""
    panel = Surface(
        Texture.BOARDS, S.vary(rng, (0.2, 0.22, 0.17), 0.5), S.WALL, 0.4, second=(0.1, 0.1, 0.09), scale=0.5
    )
    posts = np.column_stack(
        [np.arange(-length / 2, length / 2, 4.0), *[np.zeros(len(np.arange(-length / 2, length / 2, 4.0)))] * 2]
    )
    steel = Surface(Texture.PLAIN, (0.15, 0.16, 0.16), S.WALL, 0.3, scale=0.5)
    height = float(rng.uniform(2, 4.5))
    return [box(length, 0.15, height, panel), boxes(posts, (0.2, 0.25, height + 0.1), steel)]
