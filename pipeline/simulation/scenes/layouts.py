"""Street layouts: what a residential street, an arterial road, a motorway, a courtyard and a crossing are made of."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.simulation.scenes import furniture
from pipeline.simulation.scenes import surfaces as S
from pipeline.simulation.scenes.buildings import build_hall, build_house, noise_barrier
from pipeline.simulation.scenes.ground import S_MAX, S_MIN, Band, Ground, draw_road
from pipeline.simulation.scenes.mesh import Part, grid_faces
from pipeline.simulation.scenes.placing import Site
from pipeline.simulation.scenes.scene import Ego, Scene, draw_light
from pipeline.simulation.scenes.surfaces import Surface, Texture, vary
from pipeline.simulation.scenes.vegetation import build_grass, build_thicket
from pipeline.simulation.scenes.vehicles import draw_vehicle


def _asphalt(rng: np.random.Generator) -> Surface:
    tone = float(rng.uniform(0.10, 0.24))
    return Surface(
        Texture.ASPHALT,
        (tone, 0.99 * tone, 0.97 * tone),
        S.ROAD,
        float(rng.uniform(0.22, 0.34)),
        second=(0.6 * tone,) * 3,
    )


def _paving(rng: np.random.Generator) -> Surface:
    if rng.random() < 0.4:
        return _asphalt(rng).classed(S.SIDEWALK)
    colour = vary(rng, (0.28, 0.26, 0.24), 0.35)
    dark = (0.55 * colour[0], 0.55 * colour[1], 0.55 * colour[2])
    return Surface(Texture.PAVING, colour, S.SIDEWALK, 0.3, second=dark, scale=float(rng.uniform(0.15, 0.45)))


def _lawn(rng: np.random.Generator) -> Surface:
    if rng.random() < 0.15:
        return S.SOIL
    return Surface(
        Texture.GRASS, vary(rng, (0.075, 0.11, 0.03), 0.35), S.TERRAIN, 0.38, second=vary(rng, (0.17, 0.155, 0.07), 0.2)
    )


def _street(
    rng: np.random.Generator, half: float, walk: float, kerb: float, beyond: Surface, walked: Surface
) -> tuple[Band, ...]:
    """Road, kerbs, sidewalks and the land beyond, symmetric about the centre line."""
    rise = float(rng.choice([0.0, 0.0, rng.normal(0, 2.0)]))
    right = [
        Band(half, half + 0.02, 0.0, kerb, S.KERB),
        Band(half + 0.02, half + 0.16, kerb, kerb, S.KERB),
        Band(half + 0.16, half + walk, kerb, kerb + 0.02, walked),
        Band(half + walk, half + walk + 14, kerb + 0.02, kerb + 0.1, beyond),
        Band(half + walk + 14, 110.0, kerb + 0.1, kerb + 0.1 + rise, beyond),
    ]
    left = [Band(-b.outer, -b.inner, b.high, b.low, b.surface) for b in reversed(right)]
    return (*left, Band(-half, half, 0.0, 0.0, _asphalt(rng)), *right)


def _houses(
    site: Site, side: int, front: float, start: float, stop: float, low: float, high: float, gap: float
) -> None:
    """A row of houses facing the road from distance `front` on one side."""
    rng, s = site.rng, start
    while s < stop:
        length, depth, height = float(rng.uniform(8, 16)), float(rng.uniform(8, 12)), float(rng.uniform(low, high))
        setback = front + float(rng.uniform(0, 2.5))
        if not site.on_crossing(s + length / 2, length / 2 + 1):
            maker = build_hall if rng.random() < 0.08 else build_house
            site.put(maker(rng, length, depth, height), s + length / 2, side * setback, 0.0 if side > 0 else np.pi)
            edges = (side * (setback - 0.2), side * (setback + depth))
            site.taken.append((s, s + length, min(edges), max(edges)))
        s += length + float(rng.uniform(0.1, gap))


def _skyline(site: Site) -> None:
    """A ragged line of woods beyond the end of the ground, out of the LiDAR's reach, that closes the horizon."""
    rng = site.rng
    angle = np.linspace(0, 2 * np.pi, 181)
    height = np.interp(angle, np.linspace(0, 2 * np.pi, 40), rng.uniform(3, 14, 40)) + rng.uniform(-1, 1.5, 181)
    height[-1] = height[0]
    base = np.stack([30 + 135 * np.cos(angle), 118 * np.sin(angle), np.full(181, -12.0)], axis=-1)
    top = base + np.column_stack([np.zeros((181, 2)), 12 + height])
    woods = Surface(
        Texture.GRASS, vary(rng, (0.05, 0.07, 0.035), 0.4), S.VEGETATION, 0.4, second=vary(rng, (0.09, 0.11, 0.06), 0.3)
    )
    site.static.append(Part(np.concatenate([base, top]), grid_faces(2, 181), woods))


def _backdrop(site: Site, side: int, distance: float) -> None:
    """The edge of a wood, woods with undergrowth, or far houses that close the view."""
    rng = site.rng
    kind = rng.random()
    if kind < 0.7:
        site.thicket(side * distance, -45, 125, (2.0, 4.5) if kind < 0.35 else (3.0, 7.0))
    if kind < 0.35:
        site.trees(side * (distance + 2.5), -45, 125, float(rng.uniform(7, 11)), 1.5)
    if kind >= 0.7:
        _houses(site, side, distance, -50, 120, 5, 12, 14)


def _road_end(site: Site, half: float) -> None:
    """Now and then the street meets another one ahead: a house or greenery closes the view."""
    rng = site.rng
    if rng.random() < 0.3:
        s, wide = float(rng.uniform(55, 76)), 2 * half + float(rng.uniform(4, 16))
        if rng.random() < 0.5:
            site.put(build_house(rng, wide, 10, float(rng.uniform(5, 11))), s, 0.0, -np.pi / 2)
        else:
            for d in np.arange(-wide / 2, wide / 2, 9.0):
                site.put(build_thicket(rng, 0.25, 10.0, 3.0, float(rng.uniform(2, 5))), s + 1.5, float(d), np.pi / 2)
        site.taken.append((s - 2, s + 12, -wide / 2, wide / 2))


def _busyness(rng: np.random.Generator) -> float:
    """How full of cars a street is: one in three is nearly empty, others have half to more than the usual number."""
    return float(rng.uniform(0.0, 0.4)) if rng.random() < 0.33 else float(rng.uniform(0.6, 1.2))


def _some(rng: np.random.Generator, mean: float) -> int:
    """A number of things with this mean, at most three times as many."""
    return int(min(rng.poisson(mean), np.ceil(3 * mean)))


def _patches(site: Site, half: float) -> None:
    """Repairs, manhole covers and tar on the road."""
    rng, ground = site.rng, site.ground
    for _ in range(int(rng.integers(2, 9))):
        tone = float(rng.uniform(0.05, 0.2))
        surface = Surface(Texture.ASPHALT, (tone, tone, tone), S.ROAD, 0.2, second=(0.6 * tone,) * 3)
        s, d, length = (
            float(rng.uniform(2, 60)),
            float(rng.uniform(-half + 0.4, half - 0.6)),
            float(rng.uniform(0.6, 9)),
        )
        site.static.append(
            ground.strip(s, s + length, d, min(d + float(rng.uniform(0.1, 1.4)), half - 0.05), surface, 0.005)
        )


def _ego(rng: np.random.Generator, d: float, speed: float) -> Ego:
    return Ego(d + float(rng.normal(0, 0.25)), float(rng.normal(0, 0.015)), speed)


def residential(rng: np.random.Generator) -> Scene:
    """A narrow street with cars parked on both sides, gardens and houses."""
    half, walk = float(rng.uniform(3.3, 4.8)), float(rng.uniform(1.2, 2.6))
    cross = float(rng.uniform(15, 70))
    crossings = ((cross, cross + float(rng.uniform(6, 9))),) if rng.random() < 0.5 else ()
    ground = Ground(
        draw_road(rng, False),
        _street(rng, half, walk, float(rng.uniform(0.05, 0.14)), _lawn(rng), _paving(rng)),
        crossings,
    )
    site = Site(ground, rng)
    busy = _busyness(rng)
    _road_end(site, half)
    for side, yaw in ((-1, 0.0), (1, np.pi)):
        edge = half + walk
        on_kerb = rng.random() < 0.35
        site.parked_row(
            side * (half - 1.0 + 0.8 * on_kerb),
            -45 + float(rng.uniform(0, 4)),
            95,
            busy * float(rng.beta(1.6, 1.9)),
            yaw,
        )
        site.distractors(side * (half - 1.0), side * (half - 0.9), count=int(rng.integers(0, 4)))
        site.boundary(side * (edge + 0.3), -50, 100)
        _houses(site, side, edge + float(rng.uniform(3, 8)), -60 + float(rng.uniform(0, 8)), 130, 5, 10, 9)
        site.trees(side * (edge + 1.8), -45, 110, float(rng.uniform(6, 18)))
        site.bushes(side * edge + side * 0.8 - 0.4, side * edge + side * 3, int(rng.integers(2, 10)))
        site.furniture_row(side * (half + 0.45), int(rng.integers(4, 12)), np.pi if side > 0 else 0.0)
        site.walkers(side * (half + 0.5), side * edge, count=int(rng.integers(0, 4)))
        site.distractors(side * (edge + 1), side * (edge + 5), count=int(rng.integers(2, 10)))
    site.traffic(0.22 * half, np.pi, _some(rng, 0.6 * busy), 12, 75, 6)
    site.traffic(-0.2 * half, 0.0, _some(rng, 0.6 * busy), 10, 75, 6)
    site.cyclists(float(rng.choice([-1, 1])) * 0.3 * half, 0.0, int(rng.integers(0, 2)))
    _skyline(site)
    site.static += ground.parts(rng)
    _patches(site, half)
    return Scene(
        ground,
        site.static,
        site.objects,
        _ego(rng, -0.15 * half, float(rng.uniform(3, 9))),
        draw_light(rng),
        "residential",
    )


def arterial(rng: np.random.Generator) -> Scene:
    """A main road of two to four lanes with traffic, verges, trees and larger buildings."""
    lanes = int(rng.choice([1, 2]))
    half, walk = 3.4 * lanes + float(rng.uniform(0.2, 0.8)), float(rng.uniform(2.2, 5))
    cross = float(rng.uniform(18, 80))
    crossings = ((cross, cross + float(rng.uniform(8, 14))),) if rng.random() < 0.4 else ()
    ground = Ground(draw_road(rng, True), _street(rng, half, walk, 0.12, _lawn(rng), _paving(rng)), crossings)
    site = Site(ground, rng)
    busy = _busyness(rng)
    _road_end(site, half)
    for lane in range(lanes):
        d = 3.4 * (lane + 0.5)
        site.traffic(d, np.pi, _some(rng, 3 * busy), -40, 110, 12)
        site.traffic(-d, 0.0, _some(rng, 3 * busy), -40, 110, 11)
        if lane:
            site.static += ground.dashes(3.4 * lane, 3, 6) + ground.dashes(-3.4 * lane, 3, 6)
    site.static += ground.dashes(0.0, 4, 0 if lanes == 2 else 6)
    for side in (-1, 1):
        if rng.random() < 0.55:
            fill = busy * float(rng.uniform(0.2, 0.8))
            site.parked_row(side * (half + 1.1), -40, 95, fill, 0.0 if side < 0 else np.pi)
        site.furniture_row(side * (half + 0.5), int(rng.integers(5, 14)), np.pi if side > 0 else 0.0)
        site.trees(side * (half + walk + float(rng.uniform(0.5, 4))), -50, 120, float(rng.uniform(6, 14)))
        site.bushes(side * (half + walk + 3) - 2, side * (half + walk + 3) + 2, int(rng.integers(2, 9)))
        site.walkers(side * (half + 2.2), side * (half + walk), count=int(rng.integers(0, 4)))
        site.distractors(side * (half + 1.0), side * (half + walk + 5), count=int(rng.integers(2, 11)))
        if rng.random() < 0.4:
            site.thicket(side * (half + walk + float(rng.uniform(1.5, 5))), -45, 110, (1.5, 5.0))
        elif rng.random() < 0.75:
            _houses(site, side, half + walk + float(rng.uniform(4, 16)), -60, 140, 6, 18, 16)
        _backdrop(site, side, half + walk + float(rng.uniform(14, 30)))
    site.cyclists(-half + 0.6, 0.0, int(rng.integers(0, 3)))
    _skyline(site)
    site.static += ground.parts(rng)
    _patches(site, half)
    return Scene(
        ground,
        site.static,
        site.objects,
        _ego(rng, -3.4 * (rng.integers(lanes) + 0.5), float(rng.uniform(6, 14))),
        draw_light(rng),
        "arterial",
    )


def highway(rng: np.random.Generator) -> Scene:
    """A motorway: wide lanes, guard rails, barriers or fields."""
    lanes, lane = int(rng.integers(2, 4)), 3.75
    half = lanes * lane + 1.2
    grass = _lawn(rng)
    verge = float(rng.uniform(2, 5))
    rise = float(rng.choice([0.0, rng.normal(0, 2.5)]))
    bands = (
        Band(-110.0, -half - verge - 12, rise, rise, grass),
        Band(-half - verge - 12, -half - verge, rise, 0.0, grass),
        Band(-half - verge, -half - 1.5, 0.0, 0.0, grass),
        Band(-half - 1.5, half + 1.5, 0.0, 0.0, _asphalt(rng)),
        Band(half + 1.5, half + verge, 0.0, 0.0, grass),
        Band(half + verge, half + verge + 12, 0.0, -rise, grass),
        Band(half + verge + 12, 110.0, -rise, -rise, grass),
    )
    ground = Ground(draw_road(rng, True), bands)
    site = Site(ground, rng)
    busy = _busyness(rng)
    length = 12.0
    for s in np.arange(S_MIN + 10, S_MAX - 20, length):
        site.put(furniture.guard_rail(length), float(s), 0.0)
        for side in (-1, 1):
            site.put(furniture.guard_rail(length), float(s), side * (half + 1.8))
    for number in range(lanes):
        d = 1.2 + lane * (number + 0.5)
        site.traffic(d, np.pi, _some(rng, 3 * busy), -60, 120, 30)
        site.traffic(-d, 0.0, _some(rng, 3.5 * busy), -60, 120, 27)
        for side in (-1, 1):
            site.static += ground.dashes(side * (1.2 + lane * number), 6, 0 if number == 0 else 12, 0.15)
    for side in (-1, 1):
        site.static += ground.dashes(side * half, 12, 0, 0.2)
        if rng.random() < 0.35:
            for s in np.arange(-60, 140, 20.0):
                site.put(noise_barrier(rng, 20.0), float(s), side * (half + verge + 0.5))
        if rng.random() < 0.7:
            site.thicket(side * (half + verge + float(rng.uniform(2, 9))), -50, 130, (1.5, 6.0))
        site.trees(side * (half + verge + float(rng.uniform(3, 14))), -50, 130, float(rng.uniform(9, 25)), 2.5)
        site.bushes(side * (half + verge + 4) - 3, side * (half + verge + 4) + 3, int(rng.integers(3, 14)))
        site.distractors(side * (half + verge + 1), side * (half + verge + 7), int(rng.integers(0, 6)))
        _backdrop(site, side, half + float(rng.uniform(14, 40)))
    for s in rng.uniform(0, 100, int(rng.integers(1, 4))):
        site.put(furniture.traffic_sign(rng), float(s), -half - 2.4)
    _skyline(site)
    site.static += ground.parts(rng)
    return Scene(
        ground,
        site.static,
        site.objects,
        _ego(rng, -1.2 - lane * (rng.integers(lanes) + 0.5), float(rng.uniform(20, 30))),
        draw_light(rng),
        "highway",
    )


def courtyard(rng: np.random.Generator) -> Scene:
    """A yard or car park: bays of parked cars, people, clutter, buildings all round."""
    half = float(rng.uniform(8.5, 13))
    beyond = _paving(rng) if rng.random() < 0.5 else _lawn(rng)
    ground = Ground(draw_road(rng, True), _street(rng, half, 1.8, float(rng.uniform(0.0, 0.1)), beyond, _paving(rng)))
    site = Site(ground, rng)
    end, busy = float(rng.uniform(30, 70)), _busyness(rng)
    for side in (-1, 1):
        fill = busy * float(rng.uniform(0.3, 0.85))
        site.parked_bays(side * (half - 2.6), -30, end - 4, fill, side * np.pi / 2)
        _houses(site, side, half + float(rng.uniform(2.5, 7)), -45, end + 10, 6, 16, 6)
        site.walkers(side * (half - 6), side * (half - 5), count=int(rng.integers(0, 3)))
        site.furniture_row(side * (half + 0.7), int(rng.integers(3, 8)), np.pi if side > 0 else 0.0)
        site.trees(side * (half + 1.4), -30, end, float(rng.uniform(9, 20)), 0.2)
        site.distractors(side * (half - 2), side * (half + 4), count=int(rng.integers(2, 9)))
    if half > 11:
        site.parked_bays(0.0, 12, end - 8, busy * float(rng.uniform(0.1, 0.5)), np.pi / 2)
    site.distractors(-half + 6, half - 6, int(rng.integers(0, 4)), 15, end)
    site.put(build_house(rng, 2.2 * half, 12, float(rng.uniform(6, 14))), end + 2, 0.0, -np.pi / 2)
    site.taken.append((end + 1.5, end + 16, -half, half))
    site.traffic(-1.8, 0.0, _some(rng, 0.6 * busy), 9, end - 6, 3)
    site.bushes(half + 0.5, half + 3, int(rng.integers(0, 6)), stop=end)
    site.bushes(-half - 3, -half - 0.5, int(rng.integers(0, 6)), stop=end)
    _skyline(site)
    site.static += ground.parts(rng)
    _patches(site, half)
    return Scene(
        ground,
        site.static,
        site.objects,
        _ego(rng, float(rng.uniform(-3, 3)), float(rng.uniform(1, 5))),
        draw_light(rng),
        "courtyard",
    )


def crossing(rng: np.random.Generator) -> Scene:
    """A junction close ahead with cross traffic seen from the side, signals and islands."""
    half, walk = float(rng.uniform(3.6, 7.2)), float(rng.uniform(2, 4))
    start, wide = float(rng.uniform(8, 32)), float(rng.uniform(7, 13))
    ground = Ground(
        draw_road(rng, True), _street(rng, half, walk, 0.11, _lawn(rng), _paving(rng)), ((start, start + wide),)
    )
    site = Site(ground, rng)
    busy = _busyness(rng)
    _road_end(site, half)
    for direction, s in ((1, start + 0.28 * wide), (-1, start + 0.72 * wide)):
        for _ in range(_some(rng, 2.7 * busy)):
            d = float(rng.uniform(-32, 32))
            site.add(draw_vehicle(rng), s, d, direction * np.pi / 2 + float(rng.normal(0, 0.06)), 8.0)
    site.traffic(0.45 * half, np.pi, _some(rng, 1.7 * busy), 8, 100, 8)
    site.traffic(-0.45 * half, 0.0, _some(rng, 1.2 * busy), 8, 100, 8)
    if rng.random() < busy:
        place = float(rng.uniform(-4, 4))
        site.add(draw_vehicle(rng), start + wide / 2, place, float(rng.uniform(-np.pi, np.pi)), 4.0)
    site.static += ground.dashes(0.0, 3, 4)
    for d in np.arange(-half, half, 1.0):
        site.static.append(ground.strip(start - 4.5, start - 1.5, d + 0.2, d + 0.7, S.MARKING))
    for side in (-1, 1):
        site.put(furniture.traffic_light(rng), start - 1.0, side * (half + 0.5), 0.0 if side < 0 else np.pi)
        site.parked_row(
            side * (half - 1.0 if half > 5 else half + 1.1),
            -45,
            100,
            busy * float(rng.uniform(0.0, 0.8)),
            0.0 if side < 0 else np.pi,
        )
        site.walkers(side * (half + 0.6), side * (half + walk), count=int(rng.integers(0, 5)))
        site.furniture_row(side * (half + 0.6), int(rng.integers(4, 11)), np.pi if side > 0 else 0.0)
        _houses(site, side, half + walk + float(rng.uniform(0.5, 8)), -50, 130, 6, 16, 8)
        site.trees(side * (half + walk + 1), -40, 110, float(rng.uniform(9, 25)))
        site.bushes(side * (half + walk + 2) - 1, side * (half + walk + 2) + 1, int(rng.integers(1, 7)))
        site.distractors(side * (half + 1), side * (half + walk + 5), count=int(rng.integers(2, 9)))
    site.cyclists(-half + 0.7, 0.0, int(rng.integers(0, 2)))
    site.put(build_grass(rng, 6, 2.0), 8.0, -half - walk - 2)
    _skyline(site)
    site.static += ground.parts(rng)
    _patches(site, half)
    return Scene(
        ground,
        site.static,
        site.objects,
        _ego(rng, -0.45 * half, float(rng.uniform(2, 9))),
        draw_light(rng),
        "crossing",
    )


LAYOUTS: dict[str, tuple[Callable[[np.random.Generator], Scene], float]] = {
    "residential": (residential, 0.42),
    "arterial": (arterial, 0.20),
    "highway": (highway, 0.10),
    "courtyard": (courtyard, 0.12),
    "crossing": (crossing, 0.16),
}


def draw_scene(rng: np.random.Generator, layouts: tuple[str, ...] = tuple(LAYOUTS)) -> Scene:
    """A scene of one of these layouts, drawn with their usual shares."""
    shares = np.array([LAYOUTS[name][1] for name in layouts])
    name = layouts[int(rng.choice(len(layouts), p=shares / shares.sum()))]
    return LAYOUTS[name][0](rng)
