"""The LiDAR: pattern, physics, file order, rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.geometry.project import project_points
from pipeline.geometry.rings import split_rings, subsample_rows
from pipeline.simulation.lidar import MAX_RANGE, beam_directions, scan, sensor
from pipeline.simulation.scenes import surfaces as S
from pipeline.simulation.scenes.mesh import assemble, cylinder, quad
from pipeline.simulation.scenes.surfaces import CAR, GLASS_CAR, Surface, Texture
from pipeline.simulation.synth import SyntheticFrame
from pipeline.simulation.tracing import Tracer

WHITE = Surface(Texture.PLAIN, (0.8, 0.8, 0.8), S.WALL, 0.8)
IDENTITY = np.eye(4)


def _drum(radius: float, surface: Surface) -> list[object]:
    return [cylinder(radius, 60.0, surface, sides=720).at(0, 0, -30.0)]


def test_hdl64e_has_two_blocks_of_32() -> None:
    steps = -np.diff(sensor(64).elevations)
    assert len(steps) == 63
    assert (steps > 0).all()
    assert steps[:31].mean() == pytest.approx(1 / 3, abs=0.02)
    assert steps[32:].mean() == pytest.approx(1 / 2, abs=0.02)
    assert sensor(64).elevations[0] == pytest.approx(2.0, abs=0.3)
    assert -24.9 < sensor(64).elevations[-1] < -23.5


@pytest.mark.parametrize("rows", [32, 16, 8])
def test_other_sensors_have_their_rows(rows: int) -> None:
    assert len(sensor(rows).elevations) == rows


def test_unknown_sensor_is_refused() -> None:
    with pytest.raises(ValueError, match="rows: expected one of"):
        sensor(48)


def test_beams_start_forward_and_turn_left() -> None:
    directions, (rings, count) = beam_directions(sensor(64), np.random.default_rng(0))
    assert count == pytest.approx(360 / 0.17, abs=1)
    azimuth = np.degrees(np.arctan2(directions[:, 1], directions[:, 0])).reshape(rings, count)
    assert ((azimuth[:, 0] > 0) & (azimuth[:, 0] < 0.17)).all()
    np.testing.assert_allclose(np.diff(azimuth[:, :900], axis=1), 0.17, atol=1e-9)


def test_range_and_noise_inside_a_drum() -> None:
    tracer = Tracer(assemble([(0, _drum(20.0, WHITE))]))  # type: ignore[list-item]
    points = scan(tracer, sensor(64), IDENTITY, np.random.default_rng(1)).astype(np.float64)
    error = np.hypot(points[:, 0], points[:, 1]) - 20.0
    assert abs(error.mean()) < 0.01
    # 2 cm in all: a laser's own bias and each pulse's noise.
    assert error.std() == pytest.approx(0.02, abs=0.004)
    # The carrying car hides about a twentieth (as in KITTI's object frames: the lowest rings have half their points).
    assert 0.93 * 64 * 2117 < len(points) < 0.97 * 64 * 2117
    assert split_rings(points).max() == 63


def test_the_carrying_car_hides_its_tail_and_nothing_of_the_image() -> None:
    tracer = Tracer(assemble([(0, _drum(20.0, WHITE))]))  # type: ignore[list-item]
    points = scan(tracer, sensor(64), IDENTITY, np.random.default_rng(1)).astype(np.float64)
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    behind = (azimuth > 156) & (azimuth < 200)
    assert elevation[behind].min() > -18.2
    image = ((azimuth < 41) | (azimuth > 319)) & (elevation > -14)
    assert image.sum() > 0.98 * (sensor(64).elevations > -14).sum() * 82 / 0.17


def test_dark_targets_fade_before_bright_ones() -> None:
    counts = {}
    for reflectance in (0.02, 0.8):
        surface = Surface(Texture.PLAIN, (0.1, 0.1, 0.1), S.WALL, reflectance)
        tracer = Tracer(assemble([(0, _drum(60.0, surface))]))  # type: ignore[list-item]
        points = scan(tracer, sensor(16), IDENTITY, np.random.default_rng(1))
        counts[reflectance] = len(points)
    assert counts[0.02] < 0.4 * counts[0.8]


def test_nothing_returns_from_beyond_80_m() -> None:
    tracer = Tracer(assemble([(0, _drum(95.0, WHITE))]))  # type: ignore[list-item]
    assert len(scan(tracer, sensor(16), IDENTITY, np.random.default_rng(0))) == 0
    assert MAX_RANGE == 80.0


def test_glass_lets_pulses_through() -> None:
    pane = quad([(5, -3, -3), (5, 3, -3), (5, 3, 3), (5, -3, 3)], GLASS_CAR)
    tracer = Tracer(assemble([(0, [*_drum(15.0, WHITE), pane])]))  # type: ignore[list-item]
    points = scan(tracer, sensor(64), IDENTITY, np.random.default_rng(2))
    behind = (points[:, 0] > 3) & (np.abs(points[:, 1]) < 0.3 * points[:, 0]) & (np.abs(points[:, 2]) < 2)
    reach = np.linalg.norm(points[behind, :2], axis=1)
    through, on_glass = int((reach > 14).sum()), int((reach < 8).sum())
    assert through > on_glass > 0
    open_side = (points[:, 0] < -3) & (np.abs(points[:, 1]) < -0.3 * points[:, 0]) & (np.abs(points[:, 2]) < 2)
    assert through + on_glass < 0.8 * open_side.sum()


def test_intensity_is_in_kittis_form(full_frame: SyntheticFrame) -> None:
    values = full_frame.points[:, 3]
    assert values.min() == 0
    assert values.max() <= 0.99
    np.testing.assert_allclose(values * 100, np.rint(values * 100), atol=1e-4)


def test_projected_scan_reproduces_the_dense_depth(full_frame: SyntheticFrame) -> None:
    sparse = project_points(full_frame.points, full_frame.calibration, full_frame.depth.shape)
    both = (sparse > 0) & (full_frame.depth > 0)
    road = both & (full_frame.semantics == S.ROAD)
    error = np.abs(sparse - full_frame.depth)
    # Half a pixel on a road at 20 m is 25 cm of depth: compared in units of the depth change per pixel, plus noise.
    slope = np.maximum(np.abs(np.gradient(full_frame.depth, axis=0)), np.abs(np.gradient(full_frame.depth, axis=1)))
    assert (error[road] < 0.08 + slope[road]).mean() > 0.97
    wall = both & (full_frame.semantics == S.BUILDING)
    assert (error[wall] < 0.1 + slope[wall]).mean() > 0.9


def test_background_leaks_through_silhouettes_but_not_the_other_way(full_frame: SyntheticFrame) -> None:
    sparse = project_points(full_frame.points, full_frame.calibration, full_frame.depth.shape)
    both = (sparse > 0) & (full_frame.depth > 0) & (full_frame.semantics != CAR)
    behind = (sparse > full_frame.depth + 1)[both].mean()
    before = (sparse < full_frame.depth - 1)[both].mean()
    assert 0.002 < behind < 0.08
    assert before < behind


def test_scan_splits_into_its_rings_and_subsets_keep_their_share(full_frame: SyntheticFrame) -> None:
    ring = split_rings(full_frame.points)
    assert 60 <= ring.max() + 1 <= 65
    elevation = np.degrees(np.arcsin(full_frame.points[:, 2] / np.linalg.norm(full_frame.points[:, :3], axis=1)))
    medians = [np.median(elevation[ring == k]) for k in range(ring.max() + 1)]
    assert (np.diff(medians) < 0).all()
    for step in (2, 4, 8):
        kept = subsample_rows(full_frame.points, step)
        assert len(kept) * step / len(full_frame.points) == pytest.approx(1, abs=0.05)


def test_rings_of_a_hand_made_scan() -> None:
    turn = np.radians(np.arange(1, 360, 10))
    ring = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(36)])
    points = np.concatenate([ring - np.array([0, 0, k]) for k in range(3)])
    np.testing.assert_array_equal(split_rings(points), np.repeat([0, 1, 2], 36))
    np.testing.assert_array_equal(subsample_rows(points, 2), np.concatenate([points[:36], points[72:]]))
    # Two points that jitter over the forward direction do not make a ring of their own.
    jitter = np.insert(points, 36, [[1, 0.01, 0], [1, -0.01, 0]], axis=0)
    assert split_rings(jitter).max() == 2


def test_rings_of_bad_input() -> None:
    assert split_rings(np.zeros((0, 4))).shape == (0,)
    with pytest.raises(ValueError, match=r"expected \(N, 3 or more\)"):
        split_rings(np.zeros(5))
    with pytest.raises(ValueError, match="step: expected 1 or more"):
        subsample_rows(np.zeros((2, 4), dtype=np.float32), 0)


@pytest.mark.real_data
def test_real_scans_have_64_rings(kitti_object: Path) -> None:
    for path in sorted((kitti_object / "training" / "velodyne").glob("*.bin"))[:3]:
        points = np.fromfile(path, dtype=np.float32).reshape(-1, 4)
        assert split_rings(points).max() + 1 == 64
