"""Shapes, vehicles and layouts."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.simulation.scenes import surfaces as S
from pipeline.simulation.scenes.distractors import DISTRACTORS, Builder, build_distractor
from pipeline.simulation.scenes.furniture import bins, clutter, fence, phone_box, skip, traffic_light, trailer, wall
from pipeline.simulation.scenes.ground import Road
from pipeline.simulation.scenes.layouts import LAYOUTS, draw_scene
from pipeline.simulation.scenes.mesh import assemble, box, cylinder, ellipsoid, extent, fitted, pose
from pipeline.simulation.scenes.people import build_cyclist, build_pedestrian
from pipeline.simulation.scenes.vegetation import build_bush, build_hedge, build_thicket, build_tree
from pipeline.simulation.scenes.vehicles import BODIES, build_truck, build_vehicle, draw_vehicle

Rng = np.random.Generator


def test_box_stands_on_its_underside() -> None:
    low, high = extent([box(4, 2, 1, S.METAL, z=0.5)])
    np.testing.assert_allclose(low, [-2, -1, 0.5])
    np.testing.assert_allclose(high, [2, 1, 1.5])


def test_closed_shapes_have_outward_area_of_the_solid() -> None:
    # Divergence theorem: the signed volume of a closed surface is the solid's volume, up to orientation.
    for part, volume in ((box(2, 3, 4, S.METAL), 24.0), (cylinder(1, 2, S.METAL, sides=200), 2 * np.pi)):
        a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
        assert abs(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6) == pytest.approx(volume, rel=2e-3)


def test_pose_turns_counter_clockwise_and_follows_the_slope() -> None:
    np.testing.assert_allclose(pose(1, 2, 3, np.pi / 2)[:3, 0], [0, 1, 0], atol=1e-12)
    tilted = pose(0, 0, 0, 0.3, (0.1, 0.0, 1.0))
    np.testing.assert_allclose(tilted[:3, :3] @ tilted[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(tilted[:3, 2], np.array([0.1, 0, 1]) / np.sqrt(1.01))


def test_fitted_fills_exactly_the_box() -> None:
    parts = fitted([ellipsoid((1, 2, 3), (5, 5, 5), S.METAL), box(1, 1, 1, S.METAL)], 4.0, 1.8, 1.5)
    low, high = extent(parts)
    np.testing.assert_allclose(low, [-2, -0.9, 0], atol=1e-12)
    np.testing.assert_allclose(high, [2, 0.9, 1.5], atol=1e-12)


def test_assemble_numbers_surfaces_and_instances() -> None:
    scene = assemble([(0, [box(1, 1, 1, S.METAL)]), (3, [box(1, 1, 1, S.TYRE), box(1, 1, 1, S.METAL)])])
    assert scene.instance.tolist() == [0] * 12 + [3] * 24
    assert scene.surface.tolist() == [0] * 12 + [1] * 12 + [0] * 12
    assert scene.faces.max() == len(scene.vertices) - 1


@pytest.mark.parametrize("name", sorted(BODIES))
def test_each_body_fills_its_box_and_has_glass_and_wheels(name: str, rng: Rng) -> None:
    model = build_vehicle(name, rng)
    low, high = extent(model.parts)
    np.testing.assert_allclose(high - low, model.size, atol=1e-9)
    assert low[2] == pytest.approx(0)
    materials = {part.surface for part in model.parts}
    assert S.GLASS_CAR in materials
    assert S.TYRE in materials


def test_bodies_cover_the_sizes_of_cars() -> None:
    cars = [shape for shape in BODIES.values() if shape.label == "Car"]
    assert len(cars) >= 12
    assert min(shape.length for shape in cars) < 2.7
    assert max(shape.length for shape in cars) > 4.9
    assert {shape.label for shape in BODIES.values()} == {"Car", "Van"}


def test_mean_car_has_the_size_of_kittis(rng: Rng) -> None:
    sizes = np.array([draw_vehicle(rng, ("Car",)).size for _ in range(150)])
    np.testing.assert_allclose(sizes.mean(axis=0), [3.88, 1.63, 1.53], atol=0.12)


@pytest.mark.parametrize("build", [build_pedestrian, build_cyclist, build_truck, trailer])
def test_other_labelled_things_fill_their_boxes(build: object, rng: Rng) -> None:
    assert callable(build)
    model = build(rng)
    low, high = extent(model.parts)
    np.testing.assert_allclose(high - low, model.size, atol=1e-6)
    assert model.label in ("Pedestrian", "Cyclist", "Truck", "Misc")


def test_clutter_stands_on_the_ground_and_distractors_are_of_car_size(rng: Rng) -> None:
    for make in (bins, phone_box, skip, clutter, traffic_light):
        low, _ = extent(make(rng))
        assert -0.01 <= low[2] < 0.4
    low, high = extent(skip(rng))
    assert 2.5 < (high - low)[0] < 5
    low, high = extent(build_bush(rng, 1.0, 4.0, 1.8, 1.5))
    assert 1.0 < (high - low)[2] < 2.5
    for part in [*fence(rng, 8.0, True), *wall(rng, 8.0, 1.2), *build_hedge(rng, 1.0, 8.0, 0.8, 1.4)]:
        assert np.isfinite(part.vertices).all()


@pytest.mark.parametrize("build", [build for build, _ in DISTRACTORS])
def test_distractors_stand_on_the_ground_in_the_size_of_what_they_are_taken_for(build: Builder, rng: Rng) -> None:
    for detail in (1.0, 0.1):
        parts = build(rng, detail)
        low, high = extent(parts)
        size = high - low
        assert -0.3 < low[2] < 0.45
        assert 0.4 < size[2] < 2.9
        assert 0.5 < max(size[:2]) < 9.5
        # A detector must not be told of them by the class map: none is a car, and none has an instance.
        assert all(part.surface.train_id != S.CAR for part in parts)


def test_distractor_is_centred_on_its_footprint(rng: Rng) -> None:
    for _ in range(20):
        parts, (length, width) = build_distractor(rng, 0.3)
        low, high = extent(parts)
        np.testing.assert_allclose((high - low)[:2], (length, width))
        np.testing.assert_allclose((high + low)[:2], 0, atol=1e-9)


def test_thickets_close_the_view_down_to_the_ground(rng: Rng) -> None:
    low, high = extent(build_thicket(rng, 0.2, 10.0, 3.0, 4.0))
    assert low[2] < 0
    assert 2.4 < high[2] < 5.5
    assert (high - low)[0] > 9.9


def test_far_trees_have_fewer_leaves() -> None:
    near, far = (build_tree(np.random.default_rng(3), detail) for detail in (1.0, 0.1))
    assert sum(len(p.faces) for p in far) < 0.3 * sum(len(p.faces) for p in near)


def test_road_plan_is_straight_without_curvature() -> None:
    road = Road(0, 0, 0.02, 0, 100, 0)
    np.testing.assert_allclose(road.plan(np.array(12.0), np.array(-3.0)), [12, -3], atol=1e-9)
    assert float(road.height(10.0, 0.0)) == pytest.approx(0.2)
    normal = road.normal(0.0, 0.0)
    assert normal[0] == pytest.approx(-0.02, abs=1e-4)


def test_road_plan_of_an_arc() -> None:
    road = Road(1 / 100, 0, 0, 0, 100, 0)
    # After a quarter of a circle of 100 m radius the road has turned left by 90 degrees.
    np.testing.assert_allclose(road.plan(np.array(50 * np.pi), np.array(0.0)), [100, 100], atol=0.05)


@pytest.mark.parametrize("name", sorted(LAYOUTS))
def test_layouts_are_seeded_and_keep_things_apart(name: str) -> None:
    one, two = (draw_scene(np.random.default_rng(8), (name,)) for _ in range(2))
    assert one.layout == name
    np.testing.assert_array_equal(one.triangles(0.0).vertices, two.triangles(0.0).vertices)
    cars = [item for item in one.objects if item.model.label in ("Car", "Van", "Truck")]
    for i, first in enumerate(cars):
        for second in cars[:i]:
            reach = (min(first.model.size[:2]) + min(second.model.size[:2])) / 2
            assert np.hypot(first.s - second.s, first.d - second.d) > reach


def test_moving_things_move_along_their_heading() -> None:
    scene = draw_scene(np.random.default_rng(1), ("arterial",))
    moving = next(item for item in scene.objects if item.speed > 1)
    step = moving.pose(scene.ground, 0.5)[:3, 3] - moving.pose(scene.ground, 0.0)[:3, 3]
    assert np.linalg.norm(step) == pytest.approx(0.5 * moving.speed, rel=0.1)
    heading = moving.pose(scene.ground, 0.0)[:3, 0]
    assert step @ heading / np.linalg.norm(step) > 0.99
