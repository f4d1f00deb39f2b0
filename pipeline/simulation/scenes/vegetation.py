"""Trees, bushes, hedges and grass tufts: dark cores wrapped in thousands of leaf cards.

Cards scatter LiDAR returns in depth as foliage does, and give crowns ragged edges in the image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.scenes import surfaces as S
from pipeline.simulation.scenes.mesh import Part, box, cards, cylinder, ellipsoid, grid_faces, tube
from pipeline.simulation.scenes.surfaces import Surface, Texture

_GREENS: tuple[S.Colour, ...] = (
    (0.055, 0.095, 0.022), (0.035, 0.07, 0.018), (0.09, 0.12, 0.03), (0.12, 0.115, 0.03),
    (0.03, 0.055, 0.025), (0.13, 0.075, 0.03),
)  # fmt: skip


def foliage(rng: np.random.Generator) -> Surface:
    """Leaves of one plant."""
    colour = S.vary(rng, _GREENS[rng.integers(len(_GREENS))], 0.3)
    second = S.vary(rng, (colour[0] * 1.9, colour[1] * 1.7, colour[2] * 1.5), 0.1)
    return Surface(Texture.LEAVES, colour, S.VEGETATION, 0.42, second=second, scale=0.25)


def _core(leaves: Surface) -> Surface:
    dark = tuple(0.6 * channel for channel in leaves.colour)
    return Surface(Texture.LEAVES, (dark[0], dark[1], dark[2]), S.VEGETATION, 0.35, second=leaves.colour, scale=0.18)


def _blob(
    centre: NDArray[np.float64],
    radii: NDArray[np.float64],
    count: int,
    size: float,
    rng: np.random.Generator,
    leaves: Surface,
) -> Part:
    """Leaf cards in an ellipsoid, most of them near its skin."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    reach = 1 - 0.6 * rng.random(count) ** 1.5
    sizes = size * rng.uniform(0.6, 1.4, count)
    return cards(centre + direction * radii * reach[:, None], sizes, rng, leaves)


def build_tree(rng: np.random.Generator, detail: float) -> list[Part]:
    """A broad-leaved tree or, one time in seven, a conifer.

    detail  1 close to the camera, down to 0.1 far away: fewer and larger leaves
    """
    if rng.random() < 0.15:
        return _conifer(rng, detail)
    height = float(rng.uniform(4.5, 13))
    stem = float(rng.uniform(0.22, 0.38)) * height
    girth = 0.014 * height * float(rng.uniform(0.8, 1.5)) + 0.04
    leaves = foliage(rng)
    lean = rng.normal(0, 0.02, 2) * height
    rise = np.array([0, 0.5, 1.0])
    path = np.stack([lean[0] * rise**2, lean[1] * rise**2, rise * (stem + 0.25 * height)], axis=-1)
    parts = [tube(path, girth * np.array([1.25, 0.95, 0.5]), 8, S.BARK)]
    spread = float(rng.uniform(0.22, 0.36)) * height
    blobs = int(rng.integers(4, 9))
    for index in range(blobs):
        angle, out = rng.uniform(0, 2 * np.pi), spread * rng.uniform(0.15, 0.75) * (index > 0)
        level = stem + (height - stem) * rng.uniform(0.2, 0.75)
        centre = np.array([out * np.cos(angle) + lean[0], out * np.sin(angle) + lean[1], level])
        radii = np.array([1, 1, 0.75]) * spread * rng.uniform(0.45, 0.8)
        count = int(1700 * detail) + 25
        parts.append(_blob(centre, radii, count, 0.18 / np.sqrt(max(detail, 0.08)), rng, leaves))
        parts.append(ellipsoid(radii * 0.42, centre, _core(leaves), 6, 8))
        if detail > 0.3:
            branch = np.stack([path[1], 0.5 * (path[1] + centre) + (0, 0, 0.1), centre])
            parts.append(tube(branch, girth * np.array([0.45, 0.3, 0.12]), 5, S.BARK))
    return parts


def _conifer(rng: np.random.Generator, detail: float) -> list[Part]:
    height = float(rng.uniform(4, 12))
    leaves = Surface(
        Texture.LEAVES,
        S.vary(rng, (0.022, 0.045, 0.022), 0.3),
        S.VEGETATION,
        0.35,
        second=(0.05, 0.09, 0.04),
        scale=0.2,
    )
    spread = 0.2 * height
    level = rng.random(int(2200 * detail) + 90) ** 0.8
    angle = rng.uniform(0, 2 * np.pi, len(level))
    out = spread * (1 - level) * np.sqrt(rng.uniform(0.35, 1, len(level)))
    centres = np.stack([out * np.cos(angle), out * np.sin(angle), 0.5 + level * (height - 0.5)], axis=-1)
    sizes = 0.2 / np.sqrt(max(detail, 0.08)) * rng.uniform(0.6, 1.4, len(level))
    core = cylinder(0.7 * spread, 0.88 * height, _core(leaves), 9, 0.03).at(0, 0, 0.5)
    return [cylinder(0.016 * height, 0.8, S.BARK, 7), core, cards(centres, sizes, rng, leaves)]


def build_bush(rng: np.random.Generator, detail: float, length: float, width: float, height: float) -> list[Part]:
    """A bush filling about this box; car-sized ones are the distractors the thesis names."""
    leaves = foliage(rng)
    parts = []
    for _ in range(max(1, round(length / 0.9))):
        centre = np.array(
            [rng.uniform(-0.35, 0.35) * length, rng.uniform(-0.2, 0.2) * width, height * rng.uniform(0.38, 0.5)]
        )
        radii = np.array([min(length, 1.6) * 0.5, 0.42 * width, 0.5 * height]) * rng.uniform(0.75, 1.1)
        parts.append(_blob(centre, radii, int(380 * detail) + 20, 0.13 / np.sqrt(max(detail, 0.08)), rng, leaves))
        parts.append(ellipsoid(radii * 0.75, centre, _core(leaves), 6, 8))
    return parts


def build_hedge(rng: np.random.Generator, detail: float, length: float, width: float, height: float) -> list[Part]:
    """A clipped hedge along x."""
    leaves = foliage(rng)
    count = int(length * (70 * detail + 8))
    centres = rng.uniform(-0.5, 0.5, (count, 3)) * (length, width, 0) + np.column_stack(
        [np.zeros((count, 2)), height * np.sqrt(rng.random(count))]
    )
    side = rng.random(count) < 0.7
    centres[side, 1] = np.sign(centres[side, 1]) * width * rng.uniform(0.42, 0.52, int(side.sum()))
    centres[~side, 2] = height * rng.uniform(0.92, 1.04, int((~side).sum()))
    sizes = 0.12 / np.sqrt(max(detail, 0.08)) * rng.uniform(0.6, 1.4, count)
    return [box(length, 0.86 * width, 0.94 * height, _core(leaves)), cards(centres, sizes, rng, leaves)]


def build_thicket(rng: np.random.Generator, detail: float, length: float, width: float, height: float) -> list[Part]:
    """Undergrowth and the edge of a wood along x: a bumpy dark bank under leaves, closed down to the ground."""
    leaves = foliage(rng)
    along, around = max(3, int(length / 1.6) + 1), 7
    x = np.linspace(-length / 2, length / 2, along)[:, None]
    angle = np.linspace(0, np.pi, around)[None]
    crest = rng.uniform(0.65, 1.0, (along, 1))
    bump = crest * rng.uniform(0.85, 1.1, (along, around))
    y, z = 0.5 * width * np.cos(angle) * bump**0.5, height * np.sin(angle) ** 0.7 * bump - 0.2
    vertices = np.stack([np.broadcast_to(x, y.shape), y, z], axis=-1)
    bank = Part(vertices.reshape(-1, 3), grid_faces(along, around), _core(leaves))
    count = int(length * height * (14 * detail + 1.5))
    row, column = rng.integers(0, along, count), rng.integers(0, around, count)
    centres = vertices[row, column] * np.array([1, 1.02, 1.02]) + rng.normal(0, (0.6, 0.25, 0.3), (count, 3))
    centres[:, 2] = np.maximum(centres[:, 2], 0.05)
    sizes = 0.2 / np.sqrt(max(detail, 0.08)) * rng.uniform(0.6, 1.4, count)
    return [bank, cards(centres, sizes, rng, leaves)]


def build_grass(rng: np.random.Generator, length: float, width: float) -> list[Part]:
    """Weeds and grass tufts scattered over a strip."""
    count = int(length * width * 6)
    blade = Surface(
        Texture.LEAVES, S.vary(rng, (0.09, 0.12, 0.035), 0.3), S.TERRAIN, 0.4, second=(0.17, 0.17, 0.07), scale=0.3
    )
    centres = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)) * (length, width), rng.uniform(0, 0.12, count)])
    return [cards(centres, rng.uniform(0.06, 0.2, count), rng, blade)]
