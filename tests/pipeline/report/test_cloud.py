"""The packed cloud, the still picture and the values under the pointer: numbers worked out by hand."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from pipeline.base.paths import RunFolder
from pipeline.data import open_dataset
from pipeline.report import cloud as clouds
from pipeline.report.hover import NOTHING, hover_grid, hover_step
from pipeline.run_folder.frame_outputs import FrameOutputs


def random_cloud(measured: int, completed: int) -> clouds.FrameCloud:
    rng = np.random.default_rng(3)
    count = measured + completed
    points = rng.uniform((-5, -40, -3), (80, 40, 3), (count, 3)).astype(np.float32)
    source = (np.arange(count) >= measured).astype(np.uint8)
    return clouds.FrameCloud(points, {"source": source, "sigma": np.arange(count).astype(np.uint8)}, count)


def test_a_packed_cloud_reads_back_within_its_step() -> None:
    cloud = random_cloud(30, 70)
    packed = cloud.packed()
    data = base64.b64decode(packed["data"])
    assert len(data) == 100 * (3 * 2 + 2)
    places = np.frombuffer(data[:600], "<u2").reshape(3, 100).T
    points = np.array(packed["low"]) + places * np.array(packed["span"]) / 65535
    np.testing.assert_allclose(points, cloud.points, atol=0.002)  # 85 m in 65535 steps of 1.3 mm
    assert packed["colourings"] == ["source", "sigma"]
    np.testing.assert_array_equal(np.frombuffer(data[700:], np.uint8), cloud.bytes["sigma"])


def test_an_empty_cloud_packs() -> None:
    empty = clouds.FrameCloud(np.zeros((0, 3), np.float32), {"source": np.zeros(0, np.uint8)})
    assert empty.packed()["count"] == 0


@pytest.mark.parametrize(("measured", "completed", "kept"), [(500, 500, 50), (20, 980, 20), (980, 20, 80)])
def test_thinning_keeps_half_for_measured_points(measured: int, completed: int, kept: int) -> None:
    thinned = random_cloud(measured, completed).thinned(100, seed=0)
    assert len(thinned.points) == 100
    assert thinned.measured.sum() == kept
    assert thinned.total == 1000
    again = random_cloud(measured, completed).thinned(100, seed=0)
    np.testing.assert_array_equal(thinned.points, again.points)


def test_a_page_shares_its_points() -> None:
    assert clouds.point_budget(1) == 24_000
    assert clouds.point_budget(20) == 15_000
    assert (hover_step(4), hover_step(10), hover_step(20)) == (4, 6, 8)


def test_colours_of_a_frame_with_truth(run: RunFolder) -> None:
    frame = open_dataset("kitti_object", run.root.parent / "kitti")[0]
    cloud = clouds.frame_cloud(frame, FrameOutputs(run, frame.id))
    assert cloud is not None
    assert list(cloud.bytes) == ["source", "sigma", "class", "noise"]
    measured = cloud.measured
    assert set(cloud.bytes["noise"][measured]) == {clouds.MEASURED_NOISE}
    assert set(cloud.bytes["sigma"][measured]) == {clouds.MEASURED_SIGMA}
    # Stored as 0.5 x 255 = 128 of 255, shown as rint(128 / 255 x 250).
    assert set(cloud.bytes["sigma"][~measured]) <= {125, clouds.NO_BYTE}
    # Off by 1 m at 8 m, where 0.26 m is the tolerance: on the car it is noise of the foreground (2), and between two
    # surfaces (3) within five pixels of its edge, where the window reaches the 60 m behind it.
    on_car = ~measured & (cloud.bytes["class"] == 13)
    assert on_car.any()
    assert set(cloud.bytes["noise"][on_car]) == {2, 3}


def test_the_still_picture_looks_at_its_target() -> None:
    place, depth = clouds.still_pixels(np.array([clouds.TARGET, (17.0, -10.0, -1.2)]))
    np.testing.assert_allclose(place[0], (clouds.STILL_WIDTH / 2, clouds.STILL_HEIGHT / 2), atol=1e-6)
    assert depth[0] == pytest.approx(clouds.DISTANCE)
    # 10 m to the right at the same depth: focal length 0.85 widths.
    assert place[1, 0] - place[0, 0] == pytest.approx(10 * 0.85 * clouds.STILL_WIDTH / clouds.DISTANCE)


def test_hover_values_by_hand() -> None:
    values = np.arange(24, dtype=np.float32).reshape(4, 6)
    valid = np.ones((4, 6), bool)
    valid[:2, :2] = False  # a cell without any value
    valid[1, 3] = False  # the middle of the cell beside it
    grid = hover_grid(values, valid, 2, 256, "m")
    numbers = np.frombuffer(base64.b64decode(grid.data), "<u2").reshape(grid.rows, grid.columns)
    # The middle of a 2 x 2 cell is its lower right pixel; where that is missing, the smallest of the cell.
    expected = [[NOTHING, 2 * 256, 11 * 256], [19 * 256, 21 * 256, 23 * 256]]
    np.testing.assert_array_equal(numbers, expected)
    ragged = hover_grid(values[:3, :5], np.ones((3, 5), bool), 2, 256, "m")
    assert (ragged.rows, ragged.columns) == (2, 3)


def test_palettes_cover_every_byte_that_occurs() -> None:
    palettes = clouds.palettes()
    assert set(palettes["source"]["names"]) == {"0", "1"}
    assert {str(i) for i in range(6)} <= set(palettes["noise"]["names"])
    assert {str(i) for i in range(19)} <= set(palettes["class"]["names"])
