"""Rings: against every sample tried, by hand, and where there is next to nothing to find."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from completion.models.rings import find_rings, interpolate_rings
from tests.reference.completion_rings import nearest


def rings_of(sparse: np.ndarray) -> dict[str, np.ndarray]:
    found = find_rings(torch.from_numpy(sparse.astype(np.float32))[None, None])
    return {name: getattr(found, name)[0, 0].numpy() for name in found.__dataclass_fields__}


def scattered(rng: np.random.Generator, share: float) -> np.ndarray:
    sparse = rng.uniform(2, 60, (19, 26)) * (rng.random((19, 26)) < share)
    return sparse.astype(np.float32)


@pytest.mark.parametrize("share", [0.01, 0.05, 0.3])
def test_rings_are_the_cheapest_samples(rng: np.random.Generator, share: float) -> None:
    sparse = scattered(rng, share)
    found = rings_of(sparse)
    for row in range(sparse.shape[0]):
        for column in range(sparse.shape[1]):
            up, ups = nearest(sparse, row, column, True)
            down, downs = nearest(sparse, row, column, False)
            at = {name: float(map_[row, column]) for name, map_ in found.items()}
            assert at["distance_above"] == min(up, 64)
            assert at["distance_below"] == min(down, 64)
            assert at["above"] in (ups or downs)
            assert at["below"] in (downs or ups)


def test_between_is_linear_in_inverse_depth_by_distance() -> None:
    """One row below a sample at 10 m and three above one at 40 m: 1/z = 3/4 * 1/10 + 1/4 * 1/40 = 13/160."""
    sparse = np.zeros((9, 3), np.float32)
    sparse[2], sparse[6] = 10, 40
    found = rings_of(sparse)
    assert (found["distance_above"][3, 1], found["distance_below"][3, 1]) == (1, 3)
    assert found["between"][3, 1] == pytest.approx(160 / 13, rel=1e-3)
    assert found["between"][4, 1] == pytest.approx(16, rel=1e-3)  # half-way: the harmonic mean
    assert found["between"][2].tolist() == pytest.approx([10] * 3, rel=1e-3)
    np.testing.assert_array_equal(interpolate_rings(sparse), found["between"])


def test_a_plane_comes_back_between_its_rings() -> None:
    inverse = np.linspace(0.02, 0.1, 41)[:, None] * np.ones((1, 12))
    sparse = np.zeros_like(inverse)
    sparse[::8] = 1 / inverse[::8]
    np.testing.assert_allclose(interpolate_rings(sparse.astype(np.float32)) * inverse, 1, rtol=2e-3)


def test_an_empty_map_has_the_depth_of_a_street_and_no_ring() -> None:
    found = rings_of(np.zeros((6, 7)))
    for name in ("above", "below", "between"):
        assert (found[name] == 20).all()
    assert (found["distance_above"] == 64).all()
    assert (found["distance_below"] == 64).all()


def test_one_sample_fills_the_map() -> None:
    sparse = np.zeros((5, 40))
    sparse[2, 1] = 7
    found = rings_of(sparse)
    for name in ("above", "below", "between"):
        assert found[name] == pytest.approx(np.full((5, 40), 7.0))
    assert found["distance_above"][:, 1].tolist() == [64, 64, 0, 1, 2]
    assert found["distance_below"][:, 1].tolist() == [2, 1, 0, 64, 64]
    assert found["distance_above"][2, [0, 2, 5, 39]].tolist() == [2.5, 2.5, 10, 64]  # 95 is cut at 64


def test_borders_take_the_only_ring() -> None:
    sparse = np.zeros((7, 4))
    sparse[2], sparse[4] = 30, 12
    found = rings_of(sparse)
    assert (found["between"][:2] == 30).all()
    assert (found["between"][5:] == 12).all()


def test_every_image_of_a_batch_has_its_own_rings(rng: np.random.Generator) -> None:
    maps = [scattered(rng, 0.05), np.zeros((19, 26), np.float32)]
    together = find_rings(torch.from_numpy(np.stack(maps))[:, None]).between
    for one, alone in zip(together, maps):
        np.testing.assert_array_equal(one[0].numpy(), interpolate_rings(alone))
