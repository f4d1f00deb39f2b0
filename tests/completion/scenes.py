"""Small street-like scenes for tests: a ground plane, a wall and a box in front of it, thin rings of samples."""

from __future__ import annotations

import numpy as np

from completion.samples import TrainingSample
from completion.types import DepthFrame


def street(seed: int, height: int = 96, width: int = 160, row_step: int = 12) -> DepthFrame:
    """Ground below the horizon, a far wall above, one to three boxes; colours follow the objects."""
    rng = np.random.default_rng(seed)
    rows = np.arange(height)[:, None] - height * 0.35
    ground = np.where(rows > 0, 1.7 * 200 / np.maximum(rows, 1e-3), 1e3) * np.ones((1, width))
    depth = np.minimum(ground, 45.0 + rng.uniform(0, 10))
    image = np.where((depth < 40)[..., None], (90, 90, 95), (150, 160, 190)).astype(np.float64)
    for _ in range(rng.integers(1, 4)):
        near = rng.uniform(7, 20)
        bottom = int(height * 0.35 + 1.7 * 200 / near)
        size = int(300 / near)
        left = int(rng.integers(0, width - 8))
        box = (slice(max(0, bottom - size), bottom), slice(left, left + 2 * size))
        depth[box] = np.minimum(depth[box], near)
        image[box] = rng.uniform(20, 240, 3)
    image += rng.normal(0, 4, image.shape)
    target = depth.astype(np.float32)
    return DepthFrame(image.clip(0, 255).astype(np.uint8), thin(target, row_step, rng), target)


def thin(target: np.ndarray, row_step: int, rng: np.random.Generator) -> np.ndarray:
    """Every `row_step`-th row and every second column of a dense map, from a random first row."""
    sparse = np.zeros_like(target)
    first = int(rng.integers(row_step))
    sparse[first::row_step, ::2] = target[first::row_step, ::2]
    return sparse


class Streets:
    """A source of `count` scenes with random row steps, built when asked for."""

    def __init__(self, count: int, height: int = 96, width: int = 160) -> None:
        self.count, self.height, self.width = count, height, width

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> TrainingSample:
        frame = street(index, self.height, self.width)
        assert frame.target is not None
        target = frame.target
        return TrainingSample(frame, lambda rng: thin(target, int(rng.choice([4, 8, 16])), rng))
