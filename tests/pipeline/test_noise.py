"""Noise of Eq. 5.1-5.3 against numbers worked out by hand and against its own statistics; the taxonomy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.pointcloud.taxonomy import LABELS, Taxonomy, label_noise
from pipeline.simulation.noise import (
    NoiseSettings,
    add_noise,
    blur_depth,
    dilate_boundaries,
    drop_out,
    gaussian_kernel,
    misalign,
)


def test_kernel_is_equation_5_1_normalised() -> None:
    kernel = gaussian_kernel(1.0)
    assert len(kernel) == 7
    np.testing.assert_allclose(kernel.sum(), 1.0)
    np.testing.assert_allclose(kernel[4] / kernel[3], np.exp(-0.5))
    np.testing.assert_allclose(kernel[6] / kernel[3], np.exp(-4.5))


def test_blur_equals_the_double_sum(rng: np.random.Generator) -> None:
    depth = np.where(rng.random((12, 15)) < 0.7, rng.uniform(2, 50, (12, 15)), 0).astype(np.float32)
    kernel = gaussian_kernel(0.8)
    reach = len(kernel) // 2
    expected = np.zeros(depth.shape)
    for v, u in np.argwhere(depth > 0):
        total = weight = 0.0
        for s in range(-reach, reach + 1):
            for t in range(-reach, reach + 1):
                if 0 <= v + s < 12 and 0 <= u + t < 15 and depth[v + s, u + t] > 0:
                    g = kernel[s + reach] * kernel[t + reach]
                    total, weight = total + g * depth[v + s, u + t], weight + g
        expected[v, u] = total / weight
    np.testing.assert_allclose(blur_depth(depth, 0.8), expected, rtol=1e-6)


def test_blur_near_discontinuities_leaves_surfaces_alone() -> None:
    depth = np.full((9, 40), 10, np.float32)
    depth[:, 20:] = 30
    blurred = blur_depth(depth, 1.0, gap=5.0)
    np.testing.assert_array_equal(blurred[:, :17], depth[:, :17])
    np.testing.assert_array_equal(blurred[:, 23:], depth[:, 23:])
    assert (blurred[:, 18:22] > 10).all()
    assert (blurred[:, 18:22] < 30).all()
    np.testing.assert_array_equal(blur_depth(depth, 1.0, gap=25.0), depth)


def test_misalignment_has_the_standard_deviation_of_equation_5_2() -> None:
    random = np.random.default_rng(3)
    for distance in (10.0, 60.0):
        depth = np.full((200, 500), distance, np.float32)
        eta = misalign(depth, 0.01, 0.05, random) - depth
        assert abs(eta.mean()) < 0.01
        # 100,000 samples: the standard deviation is known to about 0.2 %.
        np.testing.assert_allclose(eta.std(), 0.05 + 0.01 * distance, rtol=0.02)


def test_missing_pixels_stay_missing_and_nothing_becomes_negative() -> None:
    depth = np.zeros((20, 20), np.float32)
    depth[::2] = 0.05
    noisy = add_noise(depth, NoiseSettings(dilate=1, blur=1.0, gap=0.0, slope=0.1, base=1.0), seed=5)
    assert (noisy[1::2] == 0).all()
    assert (noisy[::2] > 0).all()


def test_drop_out_share() -> None:
    kept = drop_out(np.ones((300, 300), np.float32), 0.3, np.random.default_rng(0)).mean()
    assert abs(kept - 0.7) < 0.01
    assert (drop_out(np.ones((5, 5), np.float32), 1.0, np.random.default_rng(0)) == 0).all()


def test_boundary_dilation_grows_the_near_surface() -> None:
    depth = np.full((7, 12), 30, np.float32)
    depth[:, :4] = 10
    depth[:, 4] = 0
    grown = dilate_boundaries(depth, 2, 5.0)
    assert (grown[:, 5] == 10).all()
    assert (grown[:, 6:] == 30).all()
    assert (grown[:, 4] == 0).all()
    np.testing.assert_array_equal(dilate_boundaries(depth, 2, 25.0), depth)


def test_noise_follows_the_seed() -> None:
    depth = np.full((30, 30), 20, np.float32)
    settings = NoiseSettings(slope=0.01, base=0.05, drop=0.1)
    np.testing.assert_array_equal(add_noise(depth, settings, 1), add_noise(depth, settings, 1))
    assert not np.array_equal(add_noise(depth, settings, 1), add_noise(depth, settings, 2))
    np.testing.assert_array_equal(add_noise(depth, NoiseSettings(), 1), depth)


def test_noise_refuses_nonsense() -> None:
    with pytest.raises(ValueError, match="rho > 0"):
        blur_depth(np.ones((3, 3), np.float32), 0.0)
    with pytest.raises(ValueError, match="NaN"):
        blur_depth(np.full((3, 3), np.nan, np.float32), 1.0)
    with pytest.raises(ValueError, match="noise"):
        NoiseSettings(drop=1.5)


def scene() -> tuple[np.ndarray, np.ndarray]:
    """A car at 10 m in columns 10-19 before a wall at 40 m, seen from the front."""
    truth = np.full((20, 40), 40, np.float32)
    truth[:, 10:20] = 10
    return truth, truth == 10


@pytest.mark.parametrize(
    ("column", "estimate", "expected"),
    [
        (12, 10.2, "clean"),  # tolerance 0.1 + 0.02 * 10 = 0.3
        (12, 10.4, "noise-inbet"),  # just behind the car's surface, with the wall two pixels away
        (15, 9.0, "noise-fg"),  # in front of everything: not between two surfaces
        (19, 25.0, "noise-inbet"),  # beside the edge, between 10 and 40
        (20, 25.0, "noise-inbet"),
        (22, 10.1, "noise-fg"),  # a wall pixel that took the depth of the car
        (30, 25.0, "noise-bg"),  # no other surface within five pixels
        (30, 40.8, "clean"),
        (30, 42.0, "noise-bg"),
        (30, 0.0, "unknown"),
    ],
)
def test_taxonomy_worked_by_hand(column: int, estimate: float, expected: str) -> None:
    truth, objects = scene()
    completed = truth.copy()
    completed[10, column] = estimate
    labels = label_noise(completed, truth, objects, Taxonomy())
    assert LABELS[labels[10, column]] == expected


def count_labels(labels: NDArray[np.uint8]) -> dict[str, int]:
    """Label name -> number, of any array of labels."""
    return dict(zip(LABELS, np.bincount(labels.reshape(-1), minlength=len(LABELS)).tolist()))


def test_blur_makes_noise_between_and_misalignment_does_not() -> None:
    truth, objects = scene()
    blurred = count_labels(label_noise(blur_depth(truth, 1.5), truth, objects, Taxonomy()))
    moved = count_labels(
        label_noise(misalign(truth, 0.03, 0.05, np.random.default_rng(0)), truth, objects, Taxonomy(window=1))
    )
    assert blurred["noise-inbet"] > 0
    assert blurred["noise-bg"] == 0
    assert moved["noise-fg"] > 0
    assert moved["noise-bg"] > 0
    assert sum(blurred.values()) == truth.size


def test_taxonomy_refuses_different_shapes_and_nan() -> None:
    truth, objects = scene()
    with pytest.raises(ValueError, match="shapes differ"):
        label_noise(truth[:5], truth, objects, Taxonomy())
    with pytest.raises(ValueError, match="NaN"):
        label_noise(np.full_like(truth, np.nan), truth, objects, Taxonomy())
