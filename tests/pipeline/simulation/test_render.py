"""The camera: geometry against planes worked out by hand, maps that agree with each other."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.simulation.labels import clipped_triangles, cover
from pipeline.simulation.render import camera_rays, render
from pipeline.simulation.rig import BASELINE, draw_rig
from pipeline.simulation.scenes import surfaces as S
from pipeline.simulation.scenes.mesh import assemble, box, quad
from pipeline.simulation.scenes.scene import draw_light
from pipeline.simulation.synth import SyntheticFrame
from pipeline.simulation.tracing import Tracer

# Camera at the origin of the world, looking along +z as cameras do.
P = np.array([[100.0, 0, 49.5, 0], [0, 100.0, 29.5, 0], [0, 0, 1, 0]])
WALL = [(-9.0, -9.0, 10.0), (9.0, -9.0, 10.0), (9.0, 9.0, 10.0), (-9.0, 9.0, 10.0)]


def test_rays_pass_through_their_pixels() -> None:
    shifted = P.copy()
    shifted[0, 3] = -53.0
    origin, rays = camera_rays(shifted, (60, 100))
    point = origin + 7.0 * rays[12 * 100 + 34]
    pixel = shifted @ np.append(point, 1)
    np.testing.assert_allclose(pixel[:2] / pixel[2], [34, 12], atol=1e-9)


def test_depth_is_z_and_not_range() -> None:
    tracer = Tracer(assemble([(0, [quad(WALL, S.METAL)])]))
    view = render(tracer, draw_light(np.random.default_rng(0)), P, np.eye(4), (60, 100), np.random.default_rng(0))
    np.testing.assert_allclose(view.depth, 10.0, rtol=1e-5)
    assert (view.semantics == S.POLE).all()


def test_instances_classes_and_sky() -> None:
    near = box(1.0, 1.0, 1.0, S.PLATE).moved(np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4.5], [0, 0, 0, 1]]))
    tracer = Tracer(assemble([(0, [quad([(p[0], p[1] + 9, p[2]) for p in WALL], S.METAL)]), (4, [near])]))
    view = render(tracer, draw_light(np.random.default_rng(0)), P, np.eye(4), (60, 100), np.random.default_rng(0))
    assert view.instances[30, 50] == 4
    assert view.semantics[30, 50] == S.CAR
    assert view.depth[30, 50] == pytest.approx(4.5, rel=1e-5)
    assert view.semantics[2, 2] == S.SKY
    assert view.depth[2, 2] == 0
    # The front face spans 1 m at 4.5 m: 22.2 px on either side of the centre line together.
    assert (view.instances[30] == 4).sum() == 22


def test_maps_agree_where_there_is_sky(frames: list[SyntheticFrame]) -> None:
    for frame in frames:
        np.testing.assert_array_equal(frame.depth == 0, frame.semantics == S.SKY)
        assert frame.instances[frame.depth == 0].max(initial=0) == 0
        assert frame.image.std() > 20


def test_colour_changes_at_depth_edges(full_frame: SyntheticFrame) -> None:
    grey = full_frame.image.astype(float).mean(axis=2)
    step = np.abs(np.diff(grey, axis=1))
    depth = np.where(full_frame.depth > 0, full_frame.depth, 500.0)
    edge = np.abs(np.diff(depth, axis=1)) > 0.2 * depth[:, :-1]
    assert np.median(step[edge]) > 2.5 * np.median(step[~edge])


def test_stereo_pair_has_kittis_baseline(frames: list[SyntheticFrame]) -> None:
    for frame in frames:
        assert frame.right is not None
        P2, P3 = frame.calibration.P2, frame.calibration.P3
        assert P3 is not None
        assert (P2[0, 3] - P3[0, 3]) / P2[0, 0] == pytest.approx(BASELINE)
        # A pixel of the left view lies f B / z further left in the right one, where it has the same depth.
        v, u = np.mgrid[60:118:3, 150:380:5]
        z = frame.depth[v, u]
        moved = np.rint(u - P2[0, 0] * BASELINE / np.maximum(z, 0.1)).astype(int)
        fits = (z > 3) & (moved >= 0)
        difference = np.abs(frame.right.depth[v[fits], moved[fits]] - z[fits]) / z[fits]
        assert np.median(difference) < 0.02


def test_rig_sizes_are_kittis_and_vary() -> None:
    drawn = [draw_rig(np.random.default_rng(seed), None) for seed in range(40)]
    assert {size for _, size in drawn} <= {(375, 1242), (370, 1224), (374, 1238), (370, 1226), (376, 1241)}
    assert len({size for _, size in drawn}) > 2
    for calibration, _ in drawn:
        assert 700 < calibration.P2[0, 0] < 730
        np.testing.assert_allclose(
            calibration.T_cam_velo[:3, :3] @ calibration.T_cam_velo[:3, :3].T, np.eye(3), atol=1e-9
        )
        # The lever arm: the LiDAR sits about 27 cm behind and 8 cm above the camera.
        np.testing.assert_allclose(calibration.T_velo_cam[:3, 3], [0.27, 0, -0.08], atol=0.06)


def test_cover_counts_pixel_centres() -> None:
    mask = np.zeros((6, 8), dtype=np.bool_)
    cover(np.array([[[0.5, 0.5], [4.5, 0.5], [4.5, 3.5]], [[0.5, 0.5], [4.5, 3.5], [0.5, 3.5]]]), mask)
    expected = np.zeros((6, 8), dtype=bool)
    expected[1:4, 1:5] = True
    np.testing.assert_array_equal(mask, expected)


def test_triangles_are_cut_at_the_near_plane() -> None:
    triangle = np.array([[[0, 0, -1.0], [0, 0, 1.15], [1, 0, 1.15]]])
    pieces = clipped_triangles(triangle)
    assert pieces[..., 2].min() == pytest.approx(0.15)
    area = np.linalg.norm(np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]), axis=1).sum() / 2
    # 1.15 of 2.15 m height is kept... minus the tip: the part above z = 0.15 of a triangle of area 2.15 / 2.
    assert area == pytest.approx(0.5 * 2.15 * (1 - (1.15 / 2.15) ** 2))
