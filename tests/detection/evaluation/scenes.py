"""Labels and detections made for tests: simple cars in a row, and seeded crowded frames that meet every rule."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from detection.kitti_format import KittiObject

SIZES = {
    "Car": (1.5, 1.6, 3.9),
    "Van": (2.0, 1.9, 5.0),
    "Pedestrian": (1.75, 0.6, 0.8),
    "Person_sitting": (1.3, 0.6, 0.8),
    "Cyclist": (1.7, 0.6, 1.8),
    "Truck": (3.2, 2.6, 9.0),
}


def thing(
    cls: str = "Car", x: float = 0.0, z: float = 20.0, height: float = 60.0, score: float | None = None, **changes
) -> KittiObject:
    """One object with a 2D box of the given height in pixels, beside its neighbours when x differs by 4 m."""
    item = KittiObject(
        type=cls,
        truncated=0.0,
        occluded=0,
        alpha=0.3,
        bbox=(600 + 30 * x, 150.0, 600 + 30 * x + 80, 150.0 + height),
        size=SIZES.get(cls, (1.0, 1.0, 1.0)),
        location=(x, 1.6, z),
        ry=0.3,
        score=score,
    )
    return replace(item, **changes)


def dontcare(bbox: tuple[float, float, float, float]) -> KittiObject:
    return KittiObject("DontCare", -1, -1, -10, bbox, (-1, -1, -1), (-1000, -1000, -1000), -10)


def random_frames(seed: int, frames: int, crowd: int = 6) -> tuple[list[list[KittiObject]], list[list[KittiObject]]]:
    """Labels and detections of crowded frames: near hits, doubles, ties, low boxes, other classes, DontCare."""
    rng = np.random.default_rng(seed)
    labels, detections = [], []
    for _ in range(frames):
        objects = [_random_label(rng) for _ in range(rng.integers(0, crowd + 1))]
        areas = []
        found = []
        for item in objects:
            found += [_near(rng, item) for _ in range(rng.choice([0, 1, 1, 2]))]
            if rng.random() < 0.2:
                areas.append(dontcare(tuple(np.array(item.bbox) + rng.uniform(-5, 5, 4))))
        found += [_near(rng, _random_label(rng)) for _ in range(rng.integers(0, 4))]
        rng.shuffle(found)
        labels.append(objects + areas)
        detections.append(found)
    return labels, detections


def _random_label(rng: np.random.Generator) -> KittiObject:
    cls = str(rng.choice(list(SIZES), p=[0.35, 0.1, 0.25, 0.1, 0.15, 0.05]))
    height = float(rng.choice([20, 24.9, 25, 30, 39.5, 40, 40.7, 60, 90]))
    return thing(
        cls,
        x=float(rng.uniform(-6, 6)),
        z=float(rng.uniform(10, 18)),
        height=height,
        truncated=float(rng.choice([0, 0.15, 0.2, 0.3, 0.5, 0.6])),
        occluded=int(rng.choice([0, 0, 0, 1, 2, 3])),
        alpha=float(rng.uniform(-3, 3)),
        ry=float(rng.uniform(-3, 3)),
    )


def _near(rng: np.random.Generator, item: KittiObject) -> KittiObject:
    jitter = rng.choice([0.02, 0.1, 0.3])
    cls = str(rng.choice([item.type.lower(), item.type, "Car", "Pedestrian"], p=[0.2, 0.6, 0.1, 0.1]))
    return replace(
        item,
        type=cls,
        bbox=tuple(np.array(item.bbox) + 20 * jitter * rng.standard_normal(4)),
        size=tuple(np.array(item.size) * np.exp(0.3 * jitter * rng.standard_normal(3))),
        location=tuple(np.array(item.location) + jitter * rng.standard_normal(3)),
        ry=item.ry + jitter * rng.standard_normal(),
        alpha=item.alpha + jitter * rng.standard_normal(),
        score=float(np.round(rng.standard_normal(), 1)),
    )
