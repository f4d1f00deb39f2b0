"""Pedestrians and cyclists made of ellipsoids and tapered tubes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.scenes import surfaces as S
from pipeline.simulation.scenes.mesh import Part, box, ellipsoid, fitted, joined, tube
from pipeline.simulation.scenes.surfaces import Surface, Texture
from pipeline.simulation.scenes.vehicles import Model

_CLOTHES: tuple[S.Colour, ...] = (
    (0.015, 0.015, 0.02), (0.03, 0.045, 0.11), (0.07, 0.08, 0.11), (0.35, 0.34, 0.32), (0.3, 0.03, 0.03),
    (0.10, 0.075, 0.05), (0.06, 0.12, 0.05), (0.45, 0.40, 0.28), (0.55, 0.55, 0.55), (0.10, 0.25, 0.4),
)  # fmt: skip


def _cloth(rng: np.random.Generator, train_id: int) -> Surface:
    colour = S.vary(rng, _CLOTHES[rng.integers(len(_CLOTHES))], 0.3)
    return Surface(Texture.CLOTH, colour, train_id, float(rng.uniform(0.25, 0.6)), scale=0.2, smooth=True)


def _skin(rng: np.random.Generator, train_id: int) -> Surface:
    return Surface(Texture.PLAIN, S.vary(rng, (0.42, 0.25, 0.17), 0.4), train_id, 0.45, smooth=True)


def _limb(points: list[tuple[float, float, float]], radii: list[float], surface: Surface) -> Part:
    path: NDArray[np.float64] = np.array(points)
    return tube(path, np.array(radii), 7, surface)


def build_pedestrian(rng: np.random.Generator) -> Model:
    """A person walking or standing; h 1.5-1.95 m, arms and stride drawn at random."""
    height = float(np.clip(rng.normal(1.74, 0.10), 1.45, 1.98))
    coat, trousers, skin = _cloth(rng, S.PERSON), _cloth(rng, S.PERSON), _skin(rng, S.PERSON)
    hair = Surface(Texture.PLAIN, S.vary(rng, (0.035, 0.022, 0.014), 0.6), S.PERSON, 0.3, smooth=True)
    stride = float(abs(rng.normal(0.18, 0.14)))
    swing = stride * float(rng.uniform(0.4, 1.0))
    parts = [
        ellipsoid((0.10, 0.085, 0.125), (0.02, 0, 1.64), skin),
        ellipsoid((0.105, 0.095, 0.10), (-0.01, 0, 1.68), hair),
        ellipsoid((0.13, 0.20, 0.34), (0.0, 0, 1.20), coat),
        ellipsoid((0.13, 0.17, 0.18), (0.0, 0, 0.92), trousers if rng.random() < 0.6 else coat),
    ]
    for side, phase in ((-1, 1.0), (1, -1.0)):
        foot, hand = phase * stride, -phase * swing
        parts.append(
            _limb(
                [(0, side * 0.09, 0.93), (0.45 * foot + 0.04, side * 0.095, 0.5), (foot, side * 0.10, 0.06)],
                [0.095, 0.065, 0.05],
                trousers,
            )
        )
        parts.append(box(0.26, 0.09, 0.08, S.PLASTIC_DARK.classed(S.PERSON)).at(foot + 0.06, side * 0.10))
        parts.append(
            _limb(
                [(0, side * 0.21, 1.42), (0.4 * hand, side * 0.25, 1.13), (hand + 0.06, side * 0.24, 0.88)],
                [0.06, 0.05, 0.04],
                coat,
            )
        )
    if rng.random() < 0.3:
        parts.append(ellipsoid((0.13, 0.16, 0.24), (-0.18, 0, 1.2), _cloth(rng, S.PERSON)))
    return _sized("Pedestrian", parts, height)


def _wheel(x: float, radius: float, surface: Surface) -> Part:
    angle = np.linspace(0, 2 * np.pi, 15)
    rim = np.stack([x + radius * np.cos(angle), np.zeros(15), radius + radius * np.sin(angle)], axis=-1)
    return tube(rim, np.full(15, 0.022), 5, surface)


def _frame_paint(rng: np.random.Generator) -> Surface:
    return Surface(Texture.PLAIN, S.vary(rng, _CLOTHES[rng.integers(len(_CLOTHES))], 0.3), S.BICYCLE, 0.3, gloss=0.2)


def _bicycle(frame: Surface) -> list[Part]:
    """Wheels, frame, handlebar and saddle of a bicycle along x, 1.7 m long."""
    tyre = S.TYRE.classed(S.BICYCLE)
    wheels = [_wheel(-0.52, 0.34, tyre), _wheel(0.52, 0.34, tyre)]
    tubes = (
        ((-0.52, 0.34), (-0.2, 0.85)),
        ((-0.52, 0.34), (0.0, 0.3)),
        ((0.0, 0.3), (-0.2, 0.85)),
        ((0.0, 0.3), (0.42, 0.88)),
        ((-0.2, 0.82), (0.42, 0.86)),
        ((0.42, 0.98), (0.52, 0.34)),
    )
    bars = [_limb([(start[0], 0, start[1]), (end[0], 0, end[1])], [0.024, 0.024], frame) for start, end in tubes]
    bars.append(_limb([(0.40, -0.27, 0.99), (0.44, 0, 1.0), (0.40, 0.27, 0.99)], [0.016, 0.016, 0.016], frame))
    saddle = box(0.26, 0.15, 0.06, S.PLASTIC_DARK.classed(S.BICYCLE), 0.9).at(-0.22, 0)
    return [joined(wheels), joined(bars), saddle]


def bicycle(rng: np.random.Generator) -> list[Part]:
    """A parked bicycle along x, some with a basket."""
    parts = _bicycle(_frame_paint(rng))
    if rng.random() < 0.25:
        parts.append(box(0.3, 0.34, 0.24, S.PLASTIC_DARK.classed(S.BICYCLE), 0.78).at(0.62, 0))
    return parts


def build_cyclist(rng: np.random.Generator) -> Model:
    """A rider on a bicycle; one labelled thing, two classes."""
    coat, trousers, skin = _cloth(rng, S.RIDER), _cloth(rng, S.RIDER), _skin(rng, S.RIDER)
    frame = _frame_paint(rng)
    lean = float(rng.uniform(0.05, 0.35))
    shoulder, head = (lean - 0.15, 1.36), (lean - 0.06, 1.63)
    parts = _bicycle(frame)
    parts.append(
        _limb(
            [(-0.2, 0, 0.95), ((shoulder[0] - 0.2) / 2, 0, 1.17), (shoulder[0], 0, shoulder[1])],
            [0.16, 0.155, 0.13],
            coat,
        )
    )
    parts.append(ellipsoid((0.11, 0.09, 0.13), (head[0], 0, head[1]), skin))
    if rng.random() < 0.5:
        parts.append(ellipsoid((0.14, 0.11, 0.09), (head[0] - 0.01, 0, head[1] + 0.08), coat))
    for side, crank in ((-1, 0.16), (1, -0.16)):
        parts.append(
            _limb(
                [
                    (-0.2, side * 0.09, 0.92),
                    (0.16 + crank * 0.3, side * 0.11, 0.66 + crank * 0.6),
                    (crank * 0.4, side * 0.11, 0.3 + crank * 0.9),
                ],
                [0.09, 0.065, 0.045],
                trousers,
            )
        )
        parts.append(
            _limb(
                [(shoulder[0], side * 0.19, shoulder[1]), (0.2, side * 0.25, 1.15), (0.40, side * 0.24, 1.02)],
                [0.055, 0.045, 0.035],
                coat,
            )
        )
    return _sized("Cyclist", parts, float(np.clip(rng.normal(1.74, 0.07), 1.55, 1.92)))


def _sized(label: str, parts: list[Part], height: float) -> Model:
    """The figure scaled evenly to `height`, with the box it then fills."""
    low = np.min([part.vertices.min(axis=0) for part in parts], axis=0)
    high = np.max([part.vertices.max(axis=0) for part in parts], axis=0)
    factor = height / (high[2] - low[2])
    length, width = float((high[0] - low[0]) * factor), float((high[1] - low[1]) * factor)
    return Model(label, fitted(parts, length, width, height), (length, width, height))
