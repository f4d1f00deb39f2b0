"""Every step against its obvious twin in tests/reference, on random clouds, borders, duplicates and real frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from completion.types import CompletedDepth
from pipeline.base.errors import DataError
from pipeline.geometry.back_project import back_project
from pipeline.geometry.calibration import Calibration, read_calibration
from pipeline.geometry.clouds import DenseCloud
from pipeline.geometry.in_view import lidar_pixels
from pipeline.geometry.project import project_points
from pipeline.pointcloud.depth_sampling import back_project_and_sample
from pipeline.pointcloud.grid_sampling import GridSampling, grid_sample, grid_sampling
from pipeline.pointcloud.radius_gather import Radii, radius_gather
from pipeline.pointcloud.range_image import RangeGrid, range_sample
from pipeline.pointcloud.semantic_mask import SemanticMask, object_score, semantic_mask
from pipeline.pointcloud.sigma_filter import SigmaBand, sigma_filter
from tests.reference import pointcloud_steps as twin

REPRESENTATIVES = ("nearest", "first", "centroid")


def small_calibration() -> Calibration:
    P2 = np.array([[50.0, 0, 20.3, 3.1], [0, 48, 11.7, -1.2], [0, 0, 1, 0.0027]])
    T = np.array([[0.01, -1, 0, -0.004], [0, 0.02, -1, -0.076], [1, 0.01, 0.02, -0.272], [0, 0, 0, 1.0]])
    return Calibration(P2=P2, R0_rect=np.eye(3), T_cam0_velo=T)


def clouds(most: int = 60) -> st.SearchStrategy[np.ndarray]:
    """Points on a lattice of quarter metres (cell borders, radius boundaries, duplicates) and odd ones between."""
    lattice = st.integers(-12, 12).map(lambda n: n * 0.25)
    value = st.one_of(lattice, st.floats(-3, 3, width=32))
    return st.integers(0, most).flatmap(lambda n: hnp.arrays(np.float32, (n, 3), elements=value))


# ---------------------------------------------------------------------------------------------------- back-projection


def test_back_projection_worked_by_hand() -> None:
    P2 = np.array([[100.0, 0, 10, 50], [0, 200, 5, -40], [0, 0, 1, 0]])
    calibration = Calibration(P2=P2, R0_rect=np.eye(3), T_cam0_velo=np.eye(4))
    depth = np.zeros((8, 20), np.float32)
    depth[7, 15] = 4.0
    cloud = back_project(depth, calibration, depth > 0)
    # x = (15 - 10) / 100 * 4 - 50 / 100, y = (7 - 5) / 200 * 4 + 40 / 200
    np.testing.assert_array_equal(cloud.points, np.array([[-0.3, 0.24, 4.0]], np.float32))
    assert cloud.pixels.tolist() == [7 * 20 + 15]


def test_back_projection_equals_the_loop(rng: np.random.Generator) -> None:
    depth = np.where(rng.random((23, 41)) < 0.7, rng.uniform(0.1, 80, (23, 41)), 0).astype(np.float32)
    keep = rng.random(depth.shape) < 0.8
    cloud = back_project(depth, small_calibration(), keep)
    points, pixels = twin.back_project(depth, small_calibration(), keep)
    np.testing.assert_array_equal(cloud.points, points)
    np.testing.assert_array_equal(cloud.pixels, pixels)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_back_projection_refuses_unusable_depth(bad: float) -> None:
    depth = np.ones((3, 4), np.float32)
    depth[1, 2] = bad
    with pytest.raises(DataError, match=r"finite depth >= 0 m"):
        back_project(depth, small_calibration(), np.ones((3, 4), bool))


def test_back_projection_refuses_another_mask_shape() -> None:
    with pytest.raises(DataError, match=r"\(3, 4\) mask"):
        back_project(np.ones((3, 5), np.float32), small_calibration(), np.ones((3, 4), bool))


# ------------------------------------------------------------------------------------------------------- sigma filter


def random_completed(rng: np.random.Generator, shape: tuple[int, int] = (23, 41)) -> CompletedDepth:
    foreground = rng.uniform(1, 60, shape).astype(np.float32)
    background = foreground + rng.choice([0, 0.5, 2.99, 3, 8], shape).astype(np.float32)
    sigma = rng.choice([0, 0.2, 0.21, 0.5, 0.79, 0.8, 1], shape).astype(np.float32)
    depth = sigma * foreground + (1 - sigma) * background
    depth[rng.random(shape) < 0.1] = 0
    return CompletedDepth(depth, foreground, background, sigma)


def test_sigma_filter_equals_the_printed_rule(rng: np.random.Generator) -> None:
    completed = random_completed(rng)
    for low, high, gap in ((0.2, 0.8, 3.0), (0.0, 1.0, 0.5), (0.4, 0.4, 0.0)):
        kept = sigma_filter(completed, SigmaBand(low, high, gap))
        np.testing.assert_array_equal(kept, twin.sigma_filter(completed, low, high, gap))


def test_sigma_band_is_open_in_sigma_and_closed_in_gap() -> None:
    def kept(sigma: float, gap: float) -> bool:
        maps = [np.full((1, 1), value, np.float32) for value in (10, 10, 10 + gap, sigma)]
        return bool(sigma_filter(CompletedDepth(*maps), SigmaBand())[0, 0])

    assert kept(0.2, 5)
    assert kept(0.8, 5)
    assert kept(0.5, 2.75)
    assert not kept(0.5, 3.0)
    assert not kept(0.21, 5)
    assert not kept(0.79, 5)


def test_sigma_filter_needs_surfaces() -> None:
    with pytest.raises(ValueError, match="pseudo_sigma"):
        sigma_filter(CompletedDepth(np.ones((2, 2), np.float32)), SigmaBand())


@pytest.mark.parametrize("band", [(0.8, 0.2, 3), (-0.1, 0.5, 3), (0.2, 1.1, 3), (0.2, 0.8, -1), (0.2, 0.8, np.nan)])
def test_sigma_band_refuses_nonsense(band: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="sigma filter"):
        SigmaBand(*band)


# ------------------------------------------------------------------------------------------------------ grid sampling


@settings(deadline=None, max_examples=150)
@given(clouds(), st.sampled_from([0.25, 0.2, 0.1, 1.0]), st.sampled_from(REPRESENTATIVES))
def test_grid_sampling_equals_the_dictionary(points: np.ndarray, size: float, representative: str) -> None:
    grid = GridSampling(size, representative)  # type: ignore[arg-type]
    chosen, sampled = twin.grid_sample(points, size, representative)
    np.testing.assert_array_equal(grid_sample(points, grid), chosen)
    cloud = grid_sampling(DenseCloud(points, np.arange(len(points), dtype=np.int32)), grid)
    np.testing.assert_array_equal(cloud.points, sampled)
    np.testing.assert_array_equal(cloud.pixels, chosen)


def test_grid_border_belongs_to_the_upper_cell() -> None:
    points = np.array([[0.25, 0, 0], [0.2499, 0, 0], [-1e-9, 0, 0], [0.4, 0, 0]], np.float32)
    assert grid_sample(points, GridSampling(0.25, "first")).tolist() == [0, 1, 2]


def test_of_two_equally_near_points_the_first_is_kept() -> None:
    points = np.array([[0.03, 0.01, 0.02], [0.17, 0.13, 0.19], [0.31, 0.1, 0.1]], np.float32)
    assert grid_sample(points, GridSampling(0.2)).tolist() == [0, 2]


def test_grid_table_grows_with_the_cells(rng: np.random.Generator) -> None:
    points = rng.uniform(-90, 90, (90_000, 3)).astype(np.float32)
    _, first = np.unique(np.floor(points.astype(np.float64) * 5.0), axis=0, return_index=True)
    np.testing.assert_array_equal(grid_sample(points, GridSampling(0.2, "first")), np.sort(first))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_grid_sampling_refuses_nan_and_infinity(bad: float) -> None:
    points = np.zeros((5, 3), np.float32)
    points[3, 1] = bad
    with pytest.raises(ValueError, match="NaN or infinite"):
        grid_sample(points, GridSampling())


def test_grid_sampling_refuses_coordinates_beyond_its_numbers() -> None:
    with pytest.raises(ValueError, match=r"too far for cells of 0\.2 m"):
        grid_sample(np.array([[3e5, 0, 0]], np.float32), GridSampling(0.2))


@pytest.mark.parametrize("representative", REPRESENTATIVES)
def test_one_pass_equals_the_two_steps(rng: np.random.Generator, representative: str) -> None:
    depth = np.where(rng.random((200, 301)) < 0.9, rng.uniform(3, 9, (200, 301)), 0).astype(np.float32)
    keep = rng.random(depth.shape) < 0.9
    grid = GridSampling(0.2, representative)  # type: ignore[arg-type]
    two = grid_sampling(back_project(depth, small_calibration(), keep), grid)
    one = back_project_and_sample(depth, small_calibration(), keep, grid)
    np.testing.assert_array_equal(one.points, two.points)
    np.testing.assert_array_equal(one.pixels, two.pixels)


def test_empty_maps_and_clouds_stay_empty() -> None:
    empty = np.zeros((0, 3), np.float32)
    assert len(grid_sample(empty, GridSampling())) == 0
    assert (
        len(
            back_project_and_sample(
                np.zeros((4, 5), np.float32), small_calibration(), np.ones((4, 5), bool), GridSampling(0.2, "centroid")
            )
        )
        == 0
    )
    assert radius_gather(empty, np.zeros(0, np.float32), empty, Radii()).shape == (0,)
    assert len(range_sample(empty, RangeGrid())) == 0
    one = np.ones((1, 3), np.float32)
    assert not radius_gather(one, np.ones(1, np.float32), empty, Radii()).any()


# --------------------------------------------------------------------------------------------------- radius gathering


@settings(deadline=None, max_examples=150)
@given(clouds(), clouds(40), st.sampled_from([0.25, 0.3, 0.5, 1.5]), st.data())
def test_radius_gathering_equals_all_pairs(
    points: np.ndarray, anchors: np.ndarray, near: float, data: st.DataObject
) -> None:
    forward = data.draw(hnp.arrays(np.float32, len(points), elements=st.sampled_from([1.0, 40.0, 41.0])))
    mask = radius_gather(points, forward, anchors, Radii(near, 1.0, 40.0))
    np.testing.assert_array_equal(mask, twin.radius_gather(points, forward, anchors, near, 1.0, 40.0))


def test_radius_and_split_are_inclusive() -> None:
    anchors = np.zeros((1, 3), np.float32)
    points = np.array([[0.5, 0, 0], [0.5000001, 0, 0], [0.75, 0, 0], [0, 0, -1.5]], np.float32)
    forward = np.array([40.0, 40.0, 40.00001, 41.0], np.float32)
    assert radius_gather(points, forward, anchors, Radii(0.5, 1.5, 40.0)).tolist() == [True, False, True, True]


@pytest.mark.parametrize("which", ["points", "anchors"])
def test_radius_gathering_refuses_nan(which: str) -> None:
    good, bad = np.zeros((3, 3), np.float32), np.full((3, 3), np.nan, np.float32)
    points, anchors = (bad, good) if which == "points" else (good, bad)
    with pytest.raises(ValueError, match="NaN or infinite"):
        radius_gather(points, np.ones(3, np.float32), anchors, Radii())


# -------------------------------------------------------------------------------------- range image, mask, LiDAR pixels


@pytest.mark.parametrize("rows", [64, 512])
def test_range_sampling_equals_the_loop(rng: np.random.Generator, rows: int) -> None:
    points = np.column_stack([rng.uniform(-5, 60, 3000), rng.uniform(-40, 40, 3000), rng.uniform(-3, 2, 3000)])
    points = points.astype(np.float32)
    grid = RangeGrid(rows, az_steps=128)
    expected = twin.range_sample(points, rows, 128, grid.top, grid.vertical, grid.horizontal)
    assert range_sample(points, grid).tolist() == expected


def test_range_sampling_drops_what_lies_outside_and_keeps_the_nearest() -> None:
    down = np.tan(np.radians(-1.0))
    points = np.array([[20, 0, 20 * down], [10, 0, 10 * down], [-10, 0, -0.1], [10, 0, 5], [10, 11, 0]], np.float32)
    assert range_sample(points, RangeGrid()).tolist() == [1]


def test_object_score_and_dilation(rng: np.random.Generator) -> None:
    labels = rng.choice([0, 11, 13, 255], (12, 15)).astype(np.uint8)
    np.testing.assert_array_equal(object_score(labels, (13,)), (labels == 13).astype(np.float32))
    score = rng.random((12, 15)).astype(np.float32)
    for pixels in (0, 1, 3):
        grown = semantic_mask(score, SemanticMask(dilate=pixels, threshold=0.9))
        np.testing.assert_array_equal(grown, twin.dilate(score >= np.float32(0.9), pixels))


def test_object_score_refuses_what_is_not_a_label_or_score() -> None:
    with pytest.raises(ValueError, match="uint8 trainIds or a float32 score"):
        object_score(np.zeros((2, 2), np.int64), (13,))
    with pytest.raises(ValueError, match=r"scores in \[0, 1\]"):
        object_score(np.full((2, 2), np.nan, np.float32), (13,))


# --------------------------------------------------------------------------------------------------------- real frames


@pytest.mark.real_data
@pytest.mark.parametrize("name", ["000000", "000008"])
def test_steps_on_real_frames(kitti_object: Path, name: str) -> None:
    calibration = read_calibration(kitti_object / f"training/calib/{name}.txt")
    raw = np.fromfile(kitti_object / f"training/velodyne/{name}.bin", np.float32).reshape(-1, 4)
    sparse = project_points(raw, calibration, (375, 1242))
    seen = raw[lidar_pixels(raw, calibration, (375, 1242)) >= 0]
    assert 10_000 < len(seen) < 25_000
    cloud = back_project(sparse, calibration, sparse > 0)
    # A projected return comes back to within half a pixel of where it was.
    depth = cloud.look_up(sparse)
    spread = np.hypot(depth / calibration.P2[0, 0], depth / calibration.P2[1, 1])
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(seen[:, :3]).query(cloud.points)
    assert (distance <= 0.75 * spread + 0.02).all()
    for representative in REPRESENTATIVES:
        chosen, _ = twin.grid_sample(seen, 0.2, representative)
        np.testing.assert_array_equal(
            grid_sample(np.ascontiguousarray(seen), GridSampling(0.2, representative)),  # type: ignore[arg-type]
            chosen,
        )
    some = cloud.points[::40]
    forward = depth[::40]
    np.testing.assert_array_equal(
        radius_gather(some, forward, seen[::7], Radii()), twin.radius_gather(some, forward, seen[::7], 0.3, 1.5, 40.0)
    )


def test_temporary_memory_of_a_full_frame_stays_below_15_megabytes() -> None:
    from benchmarks.pointcloud import temporary_memory

    assert temporary_memory() < 15


def test_one_pass_refuses_depth_too_far_for_its_cells() -> None:
    depth = np.full((3, 4), 4e5, np.float32)
    with pytest.raises(ValueError, match="too far for cells"):
        back_project_and_sample(depth, small_calibration(), np.ones((3, 4), bool), GridSampling(0.2))
