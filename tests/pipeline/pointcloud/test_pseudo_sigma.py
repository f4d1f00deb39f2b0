"""Two surfaces from one: what lies between two walls is found, a road is not."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.pointcloud.pseudo_sigma import pseudo_sigma
from pipeline.pointcloud.sigma_filter import SigmaBand, sigma_filter


def road(height: int = 60, width: int = 50) -> np.ndarray:
    """A road seen from 1.65 m: depth 1.65 * 700 / (v - horizon), steep far away."""
    rows = np.arange(height)[:, None] + 18.0
    return np.broadcast_to(700 * 1.65 / rows, (height, width)).astype(np.float32).copy()


def test_a_plane_has_one_surface() -> None:
    completed = pseudo_sigma(road())
    assert completed.sigma is not None
    assert (completed.sigma == 1).all()
    np.testing.assert_array_equal(completed.foreground, completed.depth)


def test_smeared_pixels_between_two_walls_are_found_and_removed() -> None:
    depth = np.full((20, 30), 10, np.float32)
    depth[:, 15:] = 30
    depth[:, 14:17] = [15, 20, 25]
    completed = pseudo_sigma(depth)
    # 15 = s * 10 + (1 - s) * 30
    assert completed.sigma is not None
    np.testing.assert_allclose(completed.sigma[10, 14:17], [0.75, 0.5, 0.25], atol=1e-6)
    kept = sigma_filter(completed, SigmaBand())
    assert not kept[:, 14:17].any()
    assert kept[:, :14].all()
    assert kept[:, 17:].all()


def test_sigma_reproduces_the_depth(rng: np.random.Generator) -> None:
    depth = rng.uniform(2, 60, (30, 40)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0
    c = pseudo_sigma(depth)
    assert c.sigma is not None
    assert c.foreground is not None
    assert c.background is not None
    np.testing.assert_allclose(c.sigma * c.foreground + (1 - c.sigma) * c.background, depth, atol=1e-4)
    assert (c.sigma[depth > 0] < 1).any()


def test_pseudo_sigma_refuses_nonsense() -> None:
    with pytest.raises(ValueError, match="NaN"):
        pseudo_sigma(np.full((3, 3), np.nan, np.float32))
    with pytest.raises(ValueError, match="radius >= 1"):
        pseudo_sigma(np.ones((3, 3), np.float32), radius=0)
