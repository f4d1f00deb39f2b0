"""Street furniture and clutter: poles, signs, lights, fences, walls, phone boxes, skips, bins, trailers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.simulation.scenes import surfaces as S
from pipeline.simulation.scenes.mesh import Part, box, boxes, cylinder, extent, quad, tube
from pipeline.simulation.scenes.surfaces import Surface, Texture
from pipeline.simulation.scenes.vehicles import Model


def _plain(colour: S.Colour, train_id: int, reflectance: float, rng: np.random.Generator) -> Surface:
    return Surface(Texture.PLAIN, S.vary(rng, colour, 0.25), train_id, reflectance, scale=0.5)


def street_lamp(rng: np.random.Generator) -> list[Part]:
    """A lamp post 4-9 m high with an arm towards +y."""
    height, reach = float(rng.uniform(4, 9)), float(rng.uniform(0.1, 1.8))
    steel = _plain((0.25, 0.26, 0.26), S.POLE, 0.35, rng)
    path = np.array([[0, 0, 0], [0, 0, 0.8 * height], [0, 0.2 * reach, 0.96 * height], [0, reach, height]])
    radius = float(rng.uniform(0.05, 0.09))
    head = box(0.25, 0.55, 0.12, steel, height - 0.06).at(0, reach, 0)
    return [tube(path, radius * np.array([1.4, 1.0, 0.7, 0.6]), 8, steel), head]


def traffic_sign(rng: np.random.Generator) -> list[Part]:
    """A pole with a plate (disc, triangle, square or direction board) facing -x, and often its grey back."""
    height = float(rng.uniform(2.1, 2.9))
    pole = cylinder(0.035, height + 0.3, S.METAL, 7)
    faces: tuple[tuple[S.Colour, S.Colour], ...] = (
        ((0.6, 0.6, 0.6), (0.5, 0.02, 0.02)), ((0.02, 0.08, 0.4), (0.6, 0.6, 0.6)),
        ((0.6, 0.45, 0.03), (0.05, 0.05, 0.05)),        ((0.6, 0.6, 0.58), (0.06, 0.06, 0.06)),
    )  # fmt: skip
    colour, second = faces[rng.integers(len(faces))]
    front = Surface(Texture.STRIPES, colour, S.TRAFFIC_SIGN, 0.95, second=second, scale=0.35)
    kind, size = rng.integers(4), float(rng.uniform(0.3, 0.42))
    sides = {0: 16, 1: 3, 2: 4}.get(int(kind), 4)
    plate = cylinder(size, 0.02, front, sides)
    turn = np.array([[0, 0, -1, -0.05], [0, 1, 0, 0], [1, 0, 0, height], [0, 0, 0, 1]], dtype=np.float64)
    plates = [plate.moved(turn)]
    if kind == 3:
        plates = [
            box(0.03, float(rng.uniform(0.5, 1.4)), float(rng.uniform(0.35, 0.7)), front, height - 0.2).at(-0.05, 0)
        ]
    return [pole, *plates]


def traffic_light(rng: np.random.Generator) -> list[Part]:
    """A signal head on a post, with a mast arm now and then."""
    post = cylinder(0.06, 3.1, S.METAL, 8)
    housing = Surface(Texture.PLAIN, (0.015, 0.02, 0.017), S.TRAFFIC_LIGHT, 0.12)
    lamp = Surface(Texture.PLAIN, (0.6, 0.03, 0.02) if rng.random() < 0.5 else (0.02, 0.5, 0.25), S.TRAFFIC_LIGHT, 0.4)
    parts = [
        post,
        box(0.18, 0.28, 0.9, housing, 2.2).at(-0.12, 0),
        box(0.02, 0.18, 0.18, lamp, 2.8 if lamp.colour[0] > 0.3 else 2.3).at(-0.22, 0),
    ]
    if rng.random() < 0.4:
        arm = np.array([[0, 0, 5.2], [0, 3.5, 5.4]])
        parts += [
            cylinder(0.09, 5.3, S.METAL, 8),
            tube(arm, np.array([0.06, 0.04]), 6, S.METAL),
            box(0.18, 0.28, 0.9, housing, 4.7).at(-0.1, 3.3),
        ]
    return parts


def bollard(rng: np.random.Generator) -> list[Part]:
    """A post of about a metre."""
    surface = Surface(
        Texture.STRIPES,
        (0.55, 0.55, 0.53),
        S.POLE,
        0.6,
        second=(0.4, 0.03, 0.03) if rng.random() < 0.5 else (0.03, 0.03, 0.03),
        scale=0.5,
    )
    return [cylinder(float(rng.uniform(0.04, 0.12)), float(rng.uniform(0.7, 1.1)), surface, 8)]


def fence(rng: np.random.Generator, length: float, near: bool) -> list[Part]:
    """A fence along x: pickets and rails, boards, or wire with posts."""
    height = float(rng.uniform(0.8, 1.6))
    kind = rng.integers(3)
    paint = ((0.5, 0.5, 0.48), (0.12, 0.08, 0.05), (0.03, 0.045, 0.03), (0.06, 0.06, 0.065))[rng.integers(4)]
    surface = replace(
        _plain(paint, S.FENCE, 0.35, rng),
        texture=Texture.BOARDS if kind == 1 else Texture.PLAIN,
        second=(0.05, 0.04, 0.03),
        scale=0.14,
    )
    posts = np.column_stack(
        [np.arange(-length / 2, length / 2 + 0.1, 2.4)] + [np.zeros(int(np.floor((length + 0.1) / 2.4)) + 1)] * 2
    )
    parts = [boxes(posts, (0.07, 0.07, height + 0.05), surface)]
    rails = np.array([[0, 0, 0.2], [0, 0, height - 0.15]])
    if kind == 1:
        return [*parts, box(length, 0.03, height - 0.08, surface, 0.06)]
    parts.append(boxes(rails, (length, 0.035, 0.05), surface))
    step = (0.13 if kind == 0 else 0.22) * (1 if near else 2)
    pickets = np.arange(-length / 2, length / 2, step)
    width = 0.07 if kind == 0 else 0.018
    where = np.column_stack([pickets, np.zeros(len(pickets)), np.full(len(pickets), 0.06)])
    return [*parts, boxes(where, (width * (1 if near else 1.6), 0.02, height - 0.1), surface)]


def wall(rng: np.random.Generator, length: float, height: float) -> list[Part]:
    """A garden wall along x with a coping."""
    brick = Surface(
        Texture.BRICK, S.vary(rng, (0.24, 0.11, 0.07), 0.3), S.WALL, 0.35, second=(0.3, 0.28, 0.25), scale=0.25
    )
    render = Surface(
        Texture.PLASTER, S.vary(rng, (0.42, 0.40, 0.36), 0.35), S.WALL, 0.5, second=(0.2, 0.19, 0.17), scale=1.5
    )
    body = brick if rng.random() < 0.5 else render
    return [
        box(length, 0.24, height, body),
        box(length + 0.04, 0.32, 0.07, _plain((0.3, 0.3, 0.29), S.WALL, 0.35, rng), height),
    ]


def guard_rail(length: float) -> list[Part]:
    """A motorway's steel beam on posts along x."""
    steel = Surface(Texture.PLAIN, (0.33, 0.34, 0.35), S.FENCE, 0.4, gloss=0.1, scale=0.5)
    posts = np.column_stack(
        [np.arange(-length / 2 + 1, length / 2, 2.0), *[np.zeros(len(np.arange(-length / 2 + 1, length / 2, 2.0)))] * 2]
    )
    return [
        boxes(posts, (0.08, 0.1, 0.7), steel),
        box(length, 0.06, 0.12, steel, 0.45),
        box(length, 0.06, 0.12, steel, 0.64),
    ]


def phone_box(rng: np.random.Generator) -> list[Part]:
    """A telephone box: glass panes in a frame under a roof, 0.9 x 0.9 x 2.3 m."""
    frame = _plain(((0.4, 0.02, 0.02), (0.35, 0.02, 0.18), (0.3, 0.3, 0.31))[rng.integers(3)], S.BUILDING, 0.4, rng)
    pane = replace(S.PANE, transmission=0.75, dropout=0.0)
    parts = [
        box(0.92, 0.92, 0.18, frame),
        box(0.95, 0.95, 0.3, frame, 2.0),
        box(0.3, 0.5, 0.7, S.INTERIOR.classed(S.BUILDING), 0.9).at(0.25, 0),
    ]
    for side in (-1, 1):
        parts += [box(0.06, 0.06, 2.0, frame).at(0.42, side * 0.42), box(0.06, 0.06, 2.0, frame).at(-0.42, side * 0.42)]
        parts += [
            box(0.8, 0.02, 1.85, pane, 0.17).at(0, side * 0.42),
            box(0.02, 0.8, 1.85, pane, 0.17).at(side * 0.42, 0),
        ]
    return parts


def skip(rng: np.random.Generator) -> list[Part]:
    """An open builders' skip of a car's size, heaped with rubble."""
    length, width, height = float(rng.uniform(3.0, 4.4)), float(rng.uniform(1.6, 1.9)), float(rng.uniform(1.1, 1.6))
    steel = _plain(
        ((0.45, 0.27, 0.02), (0.03, 0.10, 0.28), (0.12, 0.2, 0.08), (0.3, 0.06, 0.03))[rng.integers(4)],
        S.NO_CLASS,
        0.35,
        rng,
    )
    low, a, b, w = 0.62, length / 2, length / 2 * 0.62, width / 2
    corners = {"fl": (a, w, height), "fr": (a, -w, height), "bl": (-a, w, height), "br": (-a, -w, height)}
    feet = {"fl": (b, w * 0.92, 0.1), "fr": (b, -w * 0.92, 0.1), "bl": (-b, w * 0.92, 0.1), "br": (-b, -w * 0.92, 0.1)}
    parts = [
        quad([corners[i], corners[j], feet[j], feet[i]], steel)
        for i, j in (("fl", "fr"), ("fr", "br"), ("br", "bl"), ("bl", "fl"))
    ]
    parts.append(quad([feet["fl"], feet["fr"], feet["br"], feet["bl"]], steel))
    rubble = replace(S.SOIL, train_id=S.NO_CLASS)
    heap = rng.uniform(-0.4, 0.4, (9, 3)) * (length, width * 0.8, 0) + (0, 0, low * height)
    parts.append(boxes(heap, (0.6, 0.5, float(rng.uniform(0.3, 0.7))), rubble))
    return parts


def bins(rng: np.random.Generator) -> list[Part]:
    """One to four wheeled bins or a dumpster."""
    colour = ((0.02, 0.02, 0.022), (0.02, 0.06, 0.2), (0.3, 0.22, 0.02), (0.05, 0.1, 0.04))
    if rng.random() < 0.3:
        body = _plain(colour[rng.integers(4)], S.NO_CLASS, 0.25, rng)
        return [box(1.0, 1.3, 1.05, body, 0.15), box(1.05, 1.35, 0.12, body, 1.2)]
    parts = []
    for k in range(int(rng.integers(1, 5))):
        body = _plain(colour[rng.integers(4)], S.NO_CLASS, 0.25, rng)
        parts += [
            box(0.55, 0.52, 0.95, body, 0.08).at(0, 0.65 * k),
            box(0.6, 0.56, 0.07, S.PLASTIC_DARK.classed(S.NO_CLASS), 1.03).at(-0.02, 0.65 * k),
        ]
    return parts


def clutter(rng: np.random.Generator) -> list[Part]:
    """A heap the size of a car that is none: pallets, crates, a covered load, a kiosk."""
    length, width, height = float(rng.uniform(2.4, 4.6)), float(rng.uniform(1.3, 2.0)), float(rng.uniform(1.1, 1.9))
    kind = rng.integers(3)
    if kind == 0:
        wood = Surface(
            Texture.BOARDS, S.vary(rng, (0.3, 0.2, 0.11), 0.3), S.NO_CLASS, 0.45, second=(0.1, 0.07, 0.04), scale=0.15
        )
        layers = []
        for x in np.arange(-length / 2 + 0.6, length / 2, 1.25):
            tall = float(rng.uniform(0.4, 1.0)) * height
            layers.append(
                box(1.2, min(width, 1.2), tall, wood).at(x, float(rng.normal(0, 0.05)), 0, float(rng.normal(0, 0.05)))
            )
        return layers
    if kind == 1:
        cover = Surface(Texture.CLOTH, S.vary(rng, (0.14, 0.2, 0.16), 0.5), S.NO_CLASS, 0.4, scale=0.6)
        return [
            box(length, width, 0.7 * height, cover),
            box(0.7 * length, 0.8 * width, 0.3 * height, cover, 0.7 * height),
        ]
    kiosk = _plain((0.4, 0.4, 0.38), S.NO_CLASS, 0.45, rng)
    return [box(0.6 * length, 0.5, 1.3, kiosk), box(0.65 * length, 0.6, 0.06, kiosk, 1.3)]


def trailer(rng: np.random.Generator) -> Model:
    """A car trailer or caravan, labelled Misc as in KITTI."""
    length, width, height = float(rng.uniform(2.2, 5.0)), float(rng.uniform(1.4, 2.1)), float(rng.uniform(1.2, 2.5))
    body = _plain(((0.5, 0.5, 0.5), (0.2, 0.21, 0.22), (0.03, 0.06, 0.15))[rng.integers(3)], S.CAR, 0.45, rng)
    parts = [
        box(0.8 * length, width, height - 0.5, body, 0.5).at(-0.1 * length, 0),
        box(length, 0.1, 0.1, S.PLASTIC_DARK, 0.45),
    ]
    for side in (-1, 1):
        wheel = np.array(
            [[-0.1 * length, side * (width / 2 - 0.2), 0.3], [-0.1 * length, side * (width / 2 + 0.02), 0.3]]
        )
        parts.append(tube(wheel, np.full(2, 0.3), 12, S.TYRE))
    low, high = extent(parts)
    size = high - low
    return Model(
        "Misc",
        [part.at(-float(low[0] + high[0]) / 2, 0, -float(low[2])) for part in parts],
        (float(size[0]), float(size[1]), float(size[2])),
    )
