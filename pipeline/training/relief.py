"""Ground that is not level and crowns that are not smooth: a factor on every depth of a synthetic frame.

Measured on real streets, what surprises a network of synthetic ones is grass verges, banks and hedges, not roads
(docs/synthetic.md). Raising the ground by dh under a camera at height h brings its intersection with a pixel's ray
nearer, from z to z (1 - dh / h); LiDAR and camera stand close enough that one factor serves sparse map and truth.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.semantics.conventions import CLASSES

Float = NDArray[np.float32]
CAMERA_HEIGHT = 1.65
# Largest standard deviations (metres) of fine and coarse relief by class; coarse grows with the distance from the car's
# axis up to 1.5 times at 9 m.
_GROUND = {"terrain": (0.12, 0.36), "sidewalk": (0.036, 0.12), "road": (0.012, 0.06)}
_CROWN = 0.05
_REACH = 50.0  # metres ahead and half of it to either side; beyond, the field repeats its border


def relief(depth: Float, semantics: NDArray[np.uint8], K: NDArray[np.floating], rng: np.random.Generator) -> Float:
    """(H, W) factors on depth, 0.6 to 1.5. depth (H, W) metres with 0 = none, semantics (H, W) trainIds, K (3, 3)."""
    right = (np.arange(depth.shape[1]) - K[0, 2]) / K[0, 0] * depth
    raised = _ground(depth, right.astype(np.float32), semantics, rng)
    factor = 1 - (raised / CAMERA_HEIGHT).clip(-0.5, 0.5)
    crown = semantics == CLASSES.index("vegetation")
    if crown.any():
        factor[crown] = 1 + rng.uniform(0, _CROWN) * _octaves(depth.shape, rng)[crown]
    found: Float = factor.clip(0.6, 1.5).astype(np.float32)
    return found


def _ground(depth: Float, right: Float, semantics: NDArray[np.uint8], rng: np.random.Generator) -> Float:
    """(H, W) metres by which the ground is higher; 0 elsewhere."""
    fine = _field(depth, right, rng.uniform(0.8, 2), rng)
    coarse = _field(depth, right, rng.uniform(4, 10), rng) * (np.abs(right) / 6).clip(0, 1.5)
    raised = np.zeros(depth.shape, np.float32)
    for name, deviations in _GROUND.items():
        here = semantics == CLASSES.index(name)
        small, large = np.array(deviations) * rng.random(2)
        raised[here] = small * fine[here] + large * coarse[here]
    if rng.random() < 0.5:
        # A kerb, a bank or a ditch along one side.
        side, distance = rng.choice((-1, 1)), rng.uniform(3, 12)
        beside = (side * right - distance) / rng.uniform(0.05, 2)
        off_road = np.isin(semantics, [CLASSES.index(name) for name in ("terrain", "sidewalk")])
        raised += np.where(off_road, rng.uniform(-0.3, 0.5) * beside.clip(0, 1), 0)
    return raised


def _field(depth: Float, right: Float, cell: float, rng: np.random.Generator) -> Float:
    """Smooth noise of standard deviation about 1 on the ground plane, seen at every pixel."""
    nodes = rng.standard_normal((int(2 * _REACH / cell) + 2, int(2 * _REACH / cell) + 2)).astype(np.float32)
    column = ((right + _REACH) / cell).astype(np.float32)
    seen: Float = cv2.remap(nodes, column, depth / np.float32(cell), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return seen


def _octaves(shape: tuple[int, ...], rng: np.random.Generator) -> Float:
    """(H, W) noise of three octaves in the image."""
    total = np.zeros(shape, np.float32)
    cell = rng.uniform(6, 30)
    for octave in range(3):
        nodes = rng.standard_normal((int(shape[0] / cell) + 2, int(shape[1] / cell) + 2)).astype(np.float32)
        total += 0.6**octave * cv2.resize(nodes, (shape[1], shape[0]))
        cell = max(2.0, cell / 2.2)
    return total
