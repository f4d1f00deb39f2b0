"""What a detector takes for a car, a person or a rider and is none: hedge ends, shrubs, bicycle stands, bins, sheds.

None of these gets a label. Each builder returns parts round the origin, standing on z = 0, a few metres in size.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.simulation.scenes import furniture, vegetation
from pipeline.simulation.scenes import surfaces as S
from pipeline.simulation.scenes.mesh import Part, box, ellipsoid, extent, quad, tube
from pipeline.simulation.scenes.people import bicycle
from pipeline.simulation.scenes.surfaces import Surface, Texture

Rng = np.random.Generator
Builder = Callable[[Rng, float], list[Part]]


def _uniform(rng: Rng, *bounds: tuple[float, float]) -> list[float]:
    return [float(rng.uniform(low, high)) for low, high in bounds]


def _painted(rng: Rng, train_id: int = S.NO_CLASS) -> Surface:
    colours = ((0.3, 0.3, 0.31), (0.03, 0.05, 0.16), (0.05, 0.1, 0.05), (0.35, 0.03, 0.03), (0.02, 0.02, 0.022))
    colour = S.vary(rng, colours[rng.integers(len(colours))], 0.4)
    return Surface(Texture.PLAIN, colour, train_id, float(rng.uniform(0.1, 0.5)), scale=0.5)


def _wood(rng: Rng, train_id: int = S.NO_CLASS) -> Surface:
    colour = S.vary(rng, (0.24, 0.16, 0.09), 0.5)
    return Surface(Texture.BOARDS, colour, train_id, 0.4, second=(0.08, 0.06, 0.04), scale=0.15)


def hedge_block(rng: Rng, detail: float) -> list[Part]:
    """The end of a hedge, a cut block of one, or a corner; 1.0 to 1.9 m high."""
    length, width, height = _uniform(rng, (1.5, 5.0), (0.7, 1.9), (1.0, 1.9))
    parts = vegetation.build_hedge(rng, detail, length, width, height)
    if rng.random() < 0.3:
        other = vegetation.build_hedge(rng, detail, float(rng.uniform(1.5, 4.0)), width, height)
        parts += [part.at(length / 2, 0, 0, np.pi / 2) for part in other]
    return parts


def shrub(rng: Rng, detail: float) -> list[Part]:
    """A dense shrub of a car's size, 1.2 to 1.8 m high."""
    length, width, height = _uniform(rng, (1.8, 4.8), (1.3, 2.2), (1.2, 1.8))
    return vegetation.build_bush(rng, detail, length, width, height)


def bicycle_stand(rng: Rng, detail: float) -> list[Part]:
    """Two to nine bicycles side by side, leaning a little, often with hoops or a roof over them."""
    count, step = int(rng.integers(2, 10)), float(rng.uniform(0.35, 0.75))
    parts: list[Part] = []
    for k in range(count):
        x = (k - (count - 1) / 2) * step
        turn = np.pi / 2 + float(rng.normal(0, 0.1)) + (np.pi if rng.random() < 0.3 else 0.0)
        parts += [part.at(x + float(rng.normal(0, 0.06)), 0, 0, turn) for part in bicycle(rng)]
        if k % 2 and detail > 0.3:
            hoop = np.array([[x, -0.35, 0], [x, -0.35, 0.75], [x, 0.35, 0.75], [x, 0.35, 0]])
            parts.append(tube(hoop, np.full(4, 0.025), 5, S.METAL))
    if rng.random() < 0.15:
        span = count * step + 0.4
        posts = [box(0.07, 0.07, 2.2, S.METAL).at(side * span / 2, 0.9) for side in (-1, 1)]
        parts += [*posts, box(span + 0.3, 2.2, 0.08, _painted(rng), 2.2)]
    return parts


def _motorcycle(rng: Rng) -> list[Part]:
    """A parked motorcycle or scooter along x, 1.8 to 2.2 m long and about 1.1 m high."""
    paint = _painted(rng, S.MOTORCYCLE)
    dark, tyre = S.PLASTIC_DARK.classed(S.MOTORCYCLE), S.TYRE.classed(S.MOTORCYCLE)
    reach, radius = float(rng.uniform(0.62, 0.75)), float(rng.uniform(0.22, 0.32))
    parts = []
    for x in (-reach, reach):
        axle = np.array([[x, -0.06, radius], [x, 0.06, radius]])
        parts.append(tube(axle, np.full(2, radius), 12, tyre))
    fork = np.array([[reach, 0, radius], [reach - 0.28, 0, 0.95], [reach - 0.3, 0, 1.02]])
    bars = np.array([[reach - 0.32, -0.34, 1.02], [reach - 0.28, 0, 1.0], [reach - 0.32, 0.34, 1.02]])
    parts += [tube(fork, np.full(3, 0.05), 6, dark), tube(bars, np.full(3, 0.025), 5, dark)]
    parts += [ellipsoid((0.42, 0.16, 0.2), (-0.05, 0, 0.5), dark), box(0.75, 0.26, 0.1, dark, 0.72).at(-0.4, 0)]
    if rng.random() < 0.5:  # a scooter: leg shield, foot board and a box on the rack
        parts += [box(0.08, 0.4, 0.6, paint, 0.3).at(reach - 0.3, 0), box(0.8, 0.36, 0.35, paint, 0.36).at(-0.35, 0)]
        parts.append(box(0.35, 0.36, 0.3, paint, 0.85).at(-0.85, 0))
    else:
        parts += [ellipsoid((0.3, 0.15, 0.14), (0.12, 0, 0.84), paint), box(0.4, 0.2, 0.12, paint, 0.78).at(-0.7, 0)]
    return parts


def motorcycles(rng: Rng, detail: float) -> list[Part]:
    """One to four parked motorcycles and scooters side by side."""
    count = int(rng.integers(1, 5))
    parts: list[Part] = []
    for k in range(count):
        x = (k - (count - 1) / 2) * float(rng.uniform(0.9, 1.2))
        parts += [part.at(x, float(rng.normal(0, 0.1)), 0, np.pi / 2 + 0.2) for part in _motorcycle(rng)]
    return parts


def wall_corner(rng: Rng, detail: float) -> list[Part]:
    """Two low walls that meet, or a single short one."""
    length, other, height = _uniform(rng, (1.5, 5.0), (1.2, 3.5), (0.5, 1.6))
    parts = furniture.wall(rng, length, height)
    if rng.random() < 0.65:
        surface = parts[0].surface
        parts.append(box(0.24, other, height, surface).at(length / 2 - 0.12, other / 2))
    return parts


def planter(rng: Rng, detail: float) -> list[Part]:
    """One to three plant tubs of concrete or wood with shrubs in them."""
    length, width, height = _uniform(rng, (0.8, 2.4), (0.6, 1.2), (0.4, 0.8))
    concrete = Surface(Texture.PLASTER, S.vary(rng, (0.32, 0.31, 0.29), 0.3), S.NO_CLASS, 0.4, second=(0.2, 0.2, 0.19))
    tub = _wood(rng) if rng.random() < 0.4 else concrete
    parts: list[Part] = []
    for k in range(int(rng.integers(1, 4))):
        bush = vegetation.build_bush(rng, 0.6 * detail, 0.9 * length, width, float(rng.uniform(0.5, 1.2)))
        parts.append(box(length, width, height, tub).at(k * (length + 0.4), 0))
        parts += [part.at(k * (length + 0.4), 0, 0.85 * height) for part in bush]
    return parts


def bin_row(rng: Rng, detail: float) -> list[Part]:
    """Large refuse containers or recycling bells in a row, sometimes inside a fence of boards."""
    count, paint = int(rng.integers(2, 5)), _painted(rng)
    parts: list[Part] = []
    bells = rng.random() < 0.35
    for k in range(count):
        x = (k - (count - 1) / 2) * (1.6 if bells else 1.5)
        if bells:
            parts.append(ellipsoid((0.75, 0.75, 0.85), (x, 0, 0.85), paint, 8, 12))
        else:
            parts += [box(1.3, 1.0, 1.0, paint, 0.18).at(x, 0), box(1.36, 1.05, 0.18, paint, 1.18).at(x, 0.03)]
    if not bells and rng.random() < 0.4:
        fence = _wood(rng, S.FENCE)
        parts.append(box(1.5 * count + 0.4, 0.06, 1.6, fence).at(0, 0.75))
        parts += [box(0.06, 1.4, 1.6, fence).at(side * (0.75 * count + 0.2), 0.05) for side in (-1, 1)]
    return parts


def stacked_boxes(rng: Rng, detail: float) -> list[Part]:
    """Crates and boxes piled two or three high."""
    card = Surface(Texture.PLAIN, S.vary(rng, (0.33, 0.23, 0.13), 0.3), S.NO_CLASS, 0.45, scale=0.4)
    material = card if rng.random() < 0.5 else _wood(rng)
    parts = []
    for x in np.arange(0.0, float(rng.uniform(0.8, 3.5)), 0.75):
        top = 0.0
        for _ in range(int(rng.integers(1, 4))):
            side, tall = float(rng.uniform(0.45, 0.8)), float(rng.uniform(0.3, 0.6))
            parts.append(box(side, side, tall, material, top).at(x, float(rng.normal(0, 0.1)), 0, float(rng.normal())))
            top += tall
    return parts


def shed(rng: Rng, detail: float) -> list[Part]:
    """A garden shed or garage box with a pitched or flat roof."""
    length, width, height = _uniform(rng, (1.8, 3.6), (1.6, 2.6), (1.6, 2.2))
    boards, roof = _wood(rng, S.BUILDING), _painted(rng, S.BUILDING)
    parts = [box(length, width, height, boards), box(0.03, 0.8, 1.7, _painted(rng, S.BUILDING)).at(-length / 2, 0)]
    if rng.random() < 0.35:
        return [*parts, box(length + 0.3, width + 0.3, 0.12, roof, height)]
    a, b, ridge = length / 2 + 0.15, width / 2 + 0.15, height + 0.35 * width
    for side in (-1, 1):
        eaves = [(-a, side * b, height - 0.05), (a, side * b, height - 0.05)]
        parts.append(quad([*eaves, (a, 0, ridge), (-a, 0, ridge)], roof))
        end = side * length / 2
        gable = [(end, -b, height), (end, b, height), (end, 0, ridge), (end, 0, ridge)]
        parts.append(quad(gable, boards))
    return parts


def wood_pile(rng: Rng, detail: float) -> list[Part]:
    """Logs stacked between posts, 1 to 1.6 m high."""
    length, height = _uniform(rng, (1.5, 4.0), (0.9, 1.6))
    bark = Surface(Texture.BARK, S.vary(rng, (0.2, 0.14, 0.08), 0.3), S.NO_CLASS, 0.4, second=(0.3, 0.24, 0.15))
    parts = [box(length, 0.9, height, bark)]
    return [*parts, *(box(0.1, 1.0, height + 0.3, _wood(rng)).at(side * length / 2, 0) for side in (-1, 1))]


def cabinet(rng: Rng, detail: float) -> list[Part]:
    """A transformer station or a row of switch cabinets."""
    length, width, height = _uniform(rng, (0.8, 3.2), (0.4, 2.0), (1.0, 1.9))
    body = _painted(rng)
    return [box(length, width, height, body), box(length + 0.1, width + 0.1, 0.08, body, height)]


def boulders(rng: Rng, detail: float) -> list[Part]:
    """One to five rocks up to 1.3 m high."""
    rock = Surface(Texture.SOIL, S.vary(rng, (0.3, 0.28, 0.25), 0.3), S.TERRAIN, 0.35, second=(0.16, 0.15, 0.14))
    parts = []
    for k in range(int(rng.integers(1, 6))):
        a, b, c = _uniform(rng, (0.4, 1.0), (0.4, 0.8), (0.3, 0.75))
        parts.append(ellipsoid((a, b, c), (1.3 * k, float(rng.normal(0, 0.2)), 0.7 * c), rock, 6, 8))
    return parts


def _first(build: Callable[[Rng], list[Part]]) -> Builder:
    """A builder that needs no level of detail."""

    def with_detail(rng: Rng, detail: float) -> list[Part]:
        return build(rng)

    return with_detail


# Builder and weight.
DISTRACTORS: tuple[tuple[Builder, float], ...] = (
    (hedge_block, 0.15),
    (shrub, 0.15),
    (bicycle_stand, 0.10),
    (motorcycles, 0.07),
    (wall_corner, 0.07),
    (planter, 0.06),
    (bin_row, 0.06),
    (stacked_boxes, 0.04),
    (shed, 0.05),
    (wood_pile, 0.03),
    (cabinet, 0.05),
    (boulders, 0.03),
    (_first(furniture.skip), 0.05),
    (_first(furniture.phone_box), 0.04),
    (_first(furniture.clutter), 0.05),
)


def build_distractor(rng: Rng, detail: float) -> tuple[list[Part], tuple[float, float]]:
    """One of DISTRACTORS, centred on its footprint, and the footprint's (length, width) in metres."""
    weights = np.array([weight for _, weight in DISTRACTORS])
    build = DISTRACTORS[int(rng.choice(len(DISTRACTORS), p=weights / weights.sum()))][0]
    parts = build(rng, detail)
    low, high = extent(parts)
    middle = (low + high) / 2
    size = high - low
    return [part.at(-float(middle[0]), -float(middle[1])) for part in parts], (float(size[0]), float(size[1]))
