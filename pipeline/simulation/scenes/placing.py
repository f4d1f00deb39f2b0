"""A scene under construction: finds free ground and puts things on it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.simulation.scenes import furniture, vegetation
from pipeline.simulation.scenes.distractors import build_distractor
from pipeline.simulation.scenes.ground import Ground
from pipeline.simulation.scenes.mesh import Part
from pipeline.simulation.scenes.people import build_cyclist, build_pedestrian
from pipeline.simulation.scenes.scene import Placed
from pipeline.simulation.scenes.vehicles import Model, draw_vehicle

Rectangle = tuple[float, float, float, float]


@dataclass
class Site:
    """Ground, what has been put on it, and which rectangles (s, d) are taken."""

    ground: Ground
    rng: np.random.Generator
    static: list[Part] = field(default_factory=list)
    objects: list[Placed] = field(default_factory=list)
    taken: list[Rectangle] = field(default_factory=list)

    def claim(self, s: float, d: float, length: float, width: float, margin: float = 0.25) -> bool:
        """Takes a rectangle centred on (s, d) if it is free; a crossing's carriageway counts as free."""
        a, b = length / 2 + margin, width / 2 + margin
        wanted = (s - a, s + a, d - b, d + b)
        for low_s, high_s, low_d, high_d in self.taken:
            if wanted[0] < high_s and wanted[1] > low_s and wanted[2] < high_d and wanted[3] > low_d:
                return False
        self.taken.append(wanted)
        return True

    def _claim_turned(self, s: float, d: float, yaw: float, length: float, width: float) -> bool:
        """Takes the rectangle round a footprint of this length and width turned by `yaw`."""
        cos, sin = abs(np.cos(yaw)), abs(np.sin(yaw))
        return self.claim(s, d, length * cos + width * sin, length * sin + width * cos)

    def _between(self, one: float, other: float) -> float:
        """A uniform draw between two bounds in either order (the two sides of a road are mirror images)."""
        return float(self.rng.uniform(min(one, other), max(one, other)))

    def on_crossing(self, s: float, margin: float = 0.0) -> bool:
        """True when s lies in a side street's mouth."""
        return any(start - margin < s < end + margin for start, end in self.ground.crossings)

    def detail(self, s: float, d: float) -> float:
        """How fine foliage here has to be: 1 within 14 m of the camera, less with distance and behind it."""
        distance = float(np.hypot(s, d)) + 1e-6
        return float(np.clip(14.0 / distance, 0.1, 1.0)) * (1.0 if s > -4 else 0.35)

    def put(self, parts: list[Part], s: float, d: float, yaw: float = 0.0) -> None:
        """Static things, upright."""
        matrix = self.ground.place(s, d, yaw)
        self.static += [part.moved(matrix) for part in parts]

    def add(self, model: Model, s: float, d: float, yaw: float, speed: float = 0.0) -> bool:
        """A labelled thing if its place is free."""
        if not self._claim_turned(s, d, yaw, model.size[0], model.size[1]):
            return False
        self.objects.append(Placed(model, s, d, yaw, speed))
        return True

    def parked_row(self, d: float, start: float, stop: float, fill: float, yaw: float) -> None:
        """Cars one behind the other at the kerb; `fill` is the share of places taken."""
        s = start
        while s < stop:
            model = draw_vehicle(self.rng)
            length = model.size[0]
            gap = float(self.rng.uniform(0.5, 1.6))
            if self.rng.random() < fill and not self.on_crossing(s + length / 2, 4.0):
                turn = np.pi if self.rng.random() < 0.1 else 0.0
                self.add(
                    model,
                    s + length / 2,
                    d + float(self.rng.normal(0, 0.1)),
                    yaw + turn + float(self.rng.normal(0, 0.025)),
                )
            s += length + gap

    def parked_bays(self, d: float, start: float, stop: float, fill: float, yaw: float) -> None:
        """Cars side by side in bays 2.6 m wide."""
        for s in np.arange(start, stop, 2.6):
            if self.rng.random() < fill and not self.on_crossing(float(s), 3.0):
                nose_in = 0.0 if self.rng.random() < 0.6 else np.pi
                shift = float(self.rng.normal(0, 0.15))
                self.add(draw_vehicle(self.rng), float(s), d + shift, yaw + nose_in + float(self.rng.normal(0, 0.03)))

    def traffic(self, d: float, yaw: float, count: int, low: float, high: float, speed: float) -> None:
        """Driving cars, vans and lorries in a lane."""
        from pipeline.simulation.scenes.vehicles import build_truck

        for _ in range(count):
            model = build_truck(self.rng) if self.rng.random() < 0.07 else draw_vehicle(self.rng)
            s = float(self.rng.uniform(low, high))
            if abs(s) < 5 + model.size[0] / 2 and abs(d) < 6:
                continue
            self.add(model, s, d + float(self.rng.normal(0, 0.2)), yaw + float(self.rng.normal(0, 0.02)), speed)

    def walkers(self, low_d: float, high_d: float, count: int) -> None:
        """Pedestrians on a strip, alone or in pairs."""
        for _ in range(count):
            s, d = float(self.rng.uniform(-20, 55)), self._between(low_d, high_d)
            heading = float(self.rng.choice([0.0, np.pi])) + float(self.rng.normal(0, 0.4))
            for k in range(2 if self.rng.random() < 0.25 else 1):
                model = build_pedestrian(self.rng)
                self.add(model, s + 0.1 * k, d + 0.85 * k, heading, float(self.rng.choice([0.0, 1.3])))

    def cyclists(self, d: float, yaw: float, count: int) -> None:
        """Riders along a lane's edge."""
        for _ in range(count):
            s = float(self.rng.uniform(5, 50) if self.rng.random() < 0.8 else self.rng.uniform(-25, -6))
            self.add(build_cyclist(self.rng), s, d + float(self.rng.normal(0, 0.3)), yaw, 4.5)

    def trees(self, d: float, start: float, stop: float, spacing: float, spread: float = 0.6) -> None:
        """A row of trees, irregular."""
        for s in np.arange(start, stop, spacing):
            place_s, place_d = float(s + self.rng.normal(0, 0.2 * spacing)), float(d + self.rng.normal(0, spread))
            if self.rng.random() < 0.8 and not self.on_crossing(place_s) and self.claim(place_s, place_d, 0.7, 0.7):
                self.put(
                    vegetation.build_tree(self.rng, self.detail(place_s, place_d)),
                    place_s,
                    place_d,
                    float(self.rng.uniform(0, 6)),
                )

    def bushes(self, low_d: float, high_d: float, count: int, start: float = -30, stop: float = 80) -> None:
        """Bushes from knee height to the size of a car."""
        for _ in range(count):
            length, width = float(self.rng.uniform(0.8, 4.5)), float(self.rng.uniform(0.8, 2.2))
            height = float(self.rng.uniform(0.6, 2.2))
            s, d = float(self.rng.uniform(start, stop)), self._between(low_d, high_d)
            if not self.on_crossing(s) and self.claim(s, d, length, width):
                self.put(
                    vegetation.build_bush(self.rng, self.detail(s, d), length, width, height),
                    s,
                    d,
                    float(self.rng.normal(0, 0.3)),
                )

    def boundary(self, d: float, start: float, stop: float) -> None:
        """Garden fences, hedges and walls along the sidewalk, changing from plot to plot."""
        s = start
        while s < stop:
            length = float(self.rng.uniform(6, 18))
            middle = s + length / 2
            kind = self.rng.random()
            near = abs(middle) < 45
            if not self.on_crossing(middle, length / 2):
                if kind < 0.32:
                    self.put(
                        vegetation.build_hedge(
                            self.rng, self.detail(middle, d), length, 0.8, float(self.rng.uniform(0.8, 2.0))
                        ),
                        middle,
                        d,
                    )
                elif kind < 0.60:
                    self.put(furniture.fence(self.rng, length, near), middle, d)
                elif kind < 0.82:
                    self.put(furniture.wall(self.rng, length, float(self.rng.uniform(0.5, 2.0))), middle, d)
            s += length + (float(self.rng.uniform(0, 4)) if self.rng.random() < 0.6 else 0.0)

    def furniture_row(self, d: float, count: int, towards_road: float) -> None:
        """Lamps, signs, bollards, bins and, now and then, signals along the kerb; `towards_road` turns +y to it."""
        makers = (
            furniture.street_lamp,
            furniture.traffic_sign,
            furniture.bollard,
            furniture.bins,
            furniture.traffic_light,
        )
        for _ in range(count):
            s = float(self.rng.uniform(-40, 90))
            maker = makers[int(self.rng.choice(5, p=[0.32, 0.34, 0.12, 0.14, 0.08]))]
            if self.claim(s, d, 0.6, 0.6, 0.05):
                yaw = (
                    towards_road
                    if maker is furniture.street_lamp
                    else float(self.rng.choice([0.0, np.pi])) + float(self.rng.normal(0, 0.15))
                )
                self.put(maker(self.rng), s, d + float(self.rng.normal(0, 0.08)), yaw)

    def distractors(self, low_d: float, high_d: float, count: int, start: float = -8, stop: float = 60) -> None:
        """What a detector takes for a car, see `scenes.distractors`; and trailers, which KITTI labels Misc."""
        for _ in range(count):
            s, d = float(self.rng.uniform(start, stop)), self._between(low_d, high_d)
            yaw = float(self.rng.normal(0, 0.15)) + (np.pi / 2 if self.rng.random() < 0.25 else 0.0)
            if self.rng.random() < 0.06:
                self.add(furniture.trailer(self.rng), s, d, yaw)
                continue
            parts, (length, width) = build_distractor(self.rng, self.detail(s, d))
            cos, sin = abs(np.cos(yaw)), abs(np.sin(yaw))
            if not self.on_crossing(s, 1.0) and self.claim(
                s, d, length * cos + width * sin, length * sin + width * cos
            ):
                self.put(parts, s, d, yaw)

    def thicket(self, d: float, start: float, stop: float, height: tuple[float, float]) -> None:
        """Undergrowth or the edge of a wood along the road at distance d, in pieces of varying height."""
        s = start
        while s < stop:
            length, width = float(self.rng.uniform(7, 14)), float(self.rng.uniform(2, 4.5))
            tall = float(self.rng.uniform(*height))
            middle = s + length / 2
            if not self.on_crossing(middle, length / 2) and self.claim(middle, d, length, width, 0.0):
                parts = vegetation.build_thicket(self.rng, self.detail(middle, d), length + 1.0, width, tall)
                self.put(parts, middle, d + float(self.rng.normal(0, 0.5)))
            s += length + (float(self.rng.uniform(0, 9)) if self.rng.random() < 0.2 else 0.0)
