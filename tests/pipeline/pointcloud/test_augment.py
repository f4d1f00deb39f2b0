"""augment_frame: every preset, the counts, the columns, the cap, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from completion.types import CompletedDepth
from pipeline.base.errors import UsageError
from pipeline.pointcloud.augment import PRESETS, AugmentSettings, augment_frame, preset
from pipeline.pointcloud.columns import expected_error
from pipeline.pointcloud.grid_sampling import GridSampling
from pipeline.pointcloud.radius_gather import Radii
from pipeline.pointcloud.semantic_mask import SemanticMask
from tests.pipeline.pointcloud.test_steps import random_completed, small_calibration
from tests.reference import pointcloud_steps as twin

SHAPE = (40, 60)


@pytest.fixture
def frame(rng: np.random.Generator) -> tuple[CompletedDepth, np.ndarray, np.ndarray]:
    """Completed depth, raw points (some behind the camera), semantics."""
    completed = random_completed(rng, SHAPE)
    points, _ = twin.back_project(completed.depth, small_calibration(), rng.random(SHAPE) < 0.1)
    raw = np.zeros((len(points) + 20, 4), np.float32)
    raw[: len(points), :3] = points + rng.normal(0, 0.05, points.shape)
    raw[len(points) :, 0] = -5
    raw[:, 3] = rng.random(len(raw))
    semantics = np.zeros(SHAPE, np.uint8)
    semantics[10:30, 20:40] = 13
    return completed, raw, semantics


@pytest.mark.parametrize("name", list(PRESETS))
def test_every_preset_gives_a_consistent_cloud(name: str, frame: tuple) -> None:
    completed, raw, semantics = frame
    cloud = augment_frame(completed, raw, small_calibration(), preset(name), semantics)
    assert cloud.points.dtype == np.float32
    assert cloud.points.shape[1] == len(cloud.columns)
    assert cloud.columns[:5] == ("x", "y", "z", "intensity", "source")
    assert np.isfinite(cloud.points).all()
    assert len(cloud.points)
    assert cloud.counts[-1][2] == len(cloud.points)
    source = cloud.points[:, 4]
    assert set(np.unique(source)) <= {0.0, 1.0}
    assert (np.diff(source) >= 0).all()
    assert (source == 0).any() == preset(name).lidar
    assert (source == 1).any() == preset(name).completed
    assert (cloud.points[source == 1, 3] == 0).all()


def test_full_preset_equals_the_steps_by_hand(frame: tuple) -> None:
    completed, raw, semantics = frame
    calibration = small_calibration()
    cloud = augment_frame(completed, raw, calibration, preset("L_D_SF"), semantics)
    keep = twin.sigma_filter(completed, 0.2, 0.8, 3.0)
    points, pixels = twin.back_project(completed.depth, calibration, keep)
    chosen, _ = twin.grid_sample(points, 0.2, "nearest")
    points, pixels = points[chosen], pixels[chosen]
    forward = completed.depth.reshape(-1)[pixels]
    relevant = (semantics == 13).reshape(-1)[pixels]
    near_objects = relevant | twin.radius_gather(points, forward, points[relevant], 0.3, 1.5, 40)
    measured = cloud.points[cloud.points[:, 4] == 0]
    near_lidar = twin.radius_gather(points, forward, measured[:, :3], 0.3, 1.5, 40)
    np.testing.assert_array_equal(cloud.points[cloud.points[:, 4] == 1, :3], points[near_objects & near_lidar])
    assert [(step, after) for step, _, after in cloud.counts] == [
        ("crop_lidar", len(measured)),
        ("sigma_filter", int(keep.sum())),
        ("grid_sampling", len(points)),
        ("semantic_mask", int(relevant.sum())),
        ("context", int(near_objects.sum())),
        ("near_lidar", int((near_objects & near_lidar).sum())),
        ("join", len(cloud.points)),
    ]


def test_lidar_alone_is_what_the_camera_sees(frame: tuple) -> None:
    completed, raw, _ = frame
    seen = augment_frame(completed, raw, small_calibration(), preset("L"))
    everything = augment_frame(completed, raw, small_calibration(), replace(preset("L"), crop_lidar=False))
    assert len(everything.points) == len(raw)
    assert (seen.points[:, 0] > 0).all()
    np.testing.assert_array_equal(everything.points[:, :4], raw)


def test_columns(frame: tuple) -> None:
    completed, raw, semantics = frame
    names = ("semantic", "sigma", "gap", "expected_error", "nearest_return")
    chosen = AugmentSettings(sigma=None, grid=GridSampling(0.2, "first"), semantic=None, near_lidar=None, columns=names)
    cloud = augment_frame(completed, raw, small_calibration(), chosen, semantics)
    assert cloud.columns[5:] == names
    table = {name: cloud.points[:, 5 + i] for i, name in enumerate(names)}
    completed_rows = cloud.points[:, 4] == 1
    assert set(np.unique(table["semantic"])) == {0, 1}
    assert (table["sigma"][~completed_rows] == 1).all()
    assert (table["nearest_return"][~completed_rows] == 0).all()
    points, pixels = twin.back_project(completed.depth, small_calibration(), completed.depth > 0)
    pixels = pixels[twin.grid_sample(points, 0.2, "first")[0]]
    assert completed.sigma is not None
    np.testing.assert_array_equal(table["sigma"][completed_rows], completed.sigma.reshape(-1)[pixels])
    np.testing.assert_array_equal(
        table["expected_error"][completed_rows], expected_error(completed).reshape(-1)[pixels]
    )
    distance = np.linalg.norm(cloud.points[completed_rows, None, :3] - cloud.points[None, ~completed_rows, :3], axis=2)
    np.testing.assert_allclose(table["nearest_return"][completed_rows], distance.min(axis=1), rtol=1e-4, atol=1e-4)


def test_expected_error_worked_by_hand() -> None:
    maps = [np.full((1, 1), value, np.float32) for value in (12.5, 10, 20, 0.75)]
    # 3/4 of the time the truth is 2.5 m nearer, 1/4 of the time 7.5 m farther.
    assert expected_error(CompletedDepth(*maps))[0, 0] == 0.75 * 2.5 + 0.25 * 7.5


def test_soft_scores_replace_labels(frame: tuple) -> None:
    completed, raw, semantics = frame
    score = np.where(semantics == 13, 0.9, 0.2).astype(np.float32)
    hard = augment_frame(completed, raw, small_calibration(), preset("D_SF"), semantics)
    soft = augment_frame(completed, raw, small_calibration(), preset("D_SF"), score)
    np.testing.assert_array_equal(hard.points, soft.points)
    column = augment_frame(completed, raw, small_calibration(), preset("L_D_SF_mask"), score).points[:, 5]
    assert set(np.unique(column)) <= {np.float32(0), np.float32(0.2), np.float32(0.9)}


def test_cap_thins_completed_points_first_and_follows_the_seed(frame: tuple) -> None:
    completed, raw, _ = frame
    plain = preset("L_D_F")
    full = augment_frame(completed, raw, small_calibration(), plain)
    measured = int((full.points[:, 4] == 0).sum())
    capped = replace(plain, max_points=measured + 30)
    first = augment_frame(completed, raw, small_calibration(), capped, seed=1)
    np.testing.assert_array_equal(first.points[:measured], full.points[:measured])
    assert len(first.points) == measured + 30
    assert first.counts[-1] == ("max_points", len(full.points), measured + 30)
    again = augment_frame(completed, raw, small_calibration(), capped, seed=1)
    other = augment_frame(completed, raw, small_calibration(), capped, seed=2)
    np.testing.assert_array_equal(first.points, again.points)
    assert not np.array_equal(first.points, other.points)
    few = augment_frame(completed, raw, small_calibration(), replace(plain, max_points=7), seed=1)
    assert len(few.points) == 7
    assert (few.points[:, 4] == 0).all()


def test_missing_parts_are_named(frame: tuple) -> None:
    completed, raw, semantics = frame
    with pytest.raises(UsageError, match="semantics"):
        augment_frame(completed, raw, small_calibration(), preset("D_SF"))
    with pytest.raises(UsageError, match="pseudo_sigma"):
        augment_frame(CompletedDepth(completed.depth), raw, small_calibration(), preset("D_F"))
    with pytest.raises(ValueError, match=r"semantics are \(2, 2\)"):
        augment_frame(completed, raw, small_calibration(), preset("D_SF"), semantics[:2, :2])
    raw[3, 1] = np.nan
    with pytest.raises(ValueError, match=r"1 of .* NaN or infinite"):
        augment_frame(completed, raw, small_calibration(), preset("L"))
    with pytest.raises(ValueError, match="float32 x y z intensity"):
        augment_frame(completed, raw[:, :3], small_calibration(), preset("L"))


def test_empty_lidar_and_empty_depth(frame: tuple) -> None:
    _completed, raw, semantics = frame
    nothing = CompletedDepth(*[np.zeros(SHAPE, np.float32)] * 4)
    only_lidar = augment_frame(nothing, raw, small_calibration(), preset("L_D_SF"), semantics)
    assert (only_lidar.points[:, 4] == 0).all()
    assert len(only_lidar.points)
    assert len(augment_frame(nothing, raw[:0], small_calibration(), preset("L_D_SF"), semantics).points) == 0


def test_settings_refuse_nonsense() -> None:
    with pytest.raises(ValueError, match="unknown preset"):
        preset("L_D")
    for wrong in (
        {"columns": ("speed",)},
        {"classes": (300,)},
        {"max_points": -1},
        {"lidar": False, "completed": False},
    ):
        with pytest.raises(ValueError, match="augment"):
            AugmentSettings(**wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="radius gathering"):
        Radii(0.0, 1.0)
    with pytest.raises(ValueError, match="semantic mask"):
        SemanticMask(dilate=-1)
    with pytest.raises(ValueError, match="grid sampling"):
        GridSampling(0.0)
