"""What the camera sees: image, dense depth, classes and instances of one view.

Rays go through pixel centres (integer coordinates, as the projection of LiDAR points rounds), so colour and depth edges
coincide; the picture is then softened by the lens and the sensor like a photograph.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.scenes.scene import Light
from pipeline.simulation.scenes.surfaces import SKY
from pipeline.simulation.shading import shade
from pipeline.simulation.tracing import Hits, Tracer


@dataclass(frozen=True)
class View:
    """Maps of one camera, all (H, W).

    image      (H, W, 3) uint8 RGB
    depth      float32 metres along the optical axis (z of camera 0), 0 = sky
    semantics  uint8 Cityscapes trainIds
    instances  int32, 0 = none, object number + 1
    """

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    semantics: NDArray[np.uint8]
    instances: NDArray[np.int32]


def camera_rays(P: NDArray[np.float64], size: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """((3,) origin, (H*W, 3) directions with z = 1) of the pixel centres of projection P, rectified camera 0 frame."""
    height, width = size
    inverse = np.linalg.inv(P[:, :3])
    v, u = np.mgrid[0:height, 0:width]
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=-1).astype(np.float64)
    directions = pixels @ inverse.T
    return -inverse @ P[:, 3], directions / directions[:, 2:3]


def render(
    tracer: Tracer, light: Light, P: NDArray[np.float64], T_world_cam: NDArray[np.float64], size: tuple[int, int],
    rng: np.random.Generator,
) -> View:  # fmt: skip
    """All maps of the camera with projection P (3, 4) at T_world_cam (4, 4), `size` = (height, width) in pixels.

    rng  the sensor's noise and blur
    """
    origin_cam, rays_cam = camera_rays(P, size)
    rotation = T_world_cam[:3, :3]
    origin = rotation @ origin_cam + T_world_cam[:3, 3]
    rays = (rays_cam @ rotation.T).astype(np.float32)
    hits = tracer.cast(origin, rays)
    found = hits.primitive >= 0
    surface = tracer.surface_of(hits.primitive)
    depth = np.where(found, hits.reach + origin_cam[2], 0).astype(np.float32)
    semantics = np.where(found, tracer.table.train_id[surface], SKY).astype(np.uint8)
    radiance = _radiance(tracer, light, hits, surface, origin, rays, 1.0 / P[0, 0])
    return View(
        image=expose(radiance.reshape(*size, 3), semantics.reshape(size) == SKY, light, rng),
        depth=depth.reshape(size),
        semantics=semantics.reshape(size),
        instances=tracer.instance_of(hits.primitive).reshape(size),
    )


def _radiance(
    tracer: Tracer, light: Light, hits: Hits, surface: NDArray[np.int32], origin: NDArray[np.float64],
    rays: NDArray[np.float32], pixel: float,
) -> NDArray[np.float32]:  # fmt: skip
    """(N, 3) linear radiance along the rays."""
    found = surface >= 0
    table = tracer.table
    reach = np.where(found, hits.reach, 0).astype(np.float32)
    points = origin.astype(np.float32) + rays * reach[:, None]
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    sun = np.array(light.sun)
    lit = np.zeros(len(rays), dtype=bool)
    if light.direct > 0:
        candidates = np.flatnonzero(found)
        start = points[candidates] + hits.normal[candidates] * 0.02 + sun.astype(np.float32) * 0.01
        lit[candidates] = ~tracer.blocked(start, sun)
    normals = _shading_normals(tracer, hits, surface, rays)
    return np.asarray(
        shade(
            points, normals, rays / length, reach * length[:, 0], surface, hits.primitive, lit, table.texture,
            table.colour, table.second, table.scale, table.gloss, sun, light.direct, light.ambient,
            np.array(light.sky), np.array(light.horizon), light.clouds, pixel,
        )
    )  # fmt: skip


def _shading_normals(
    tracer: Tracer, hits: Hits, surface: NDArray[np.int32], rays: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Triangle normals, interpolated between vertices on smooth surfaces."""
    normals = hits.normal.copy()
    smooth = np.flatnonzero((surface >= 0) & tracer.table.smooth[surface])
    if len(smooth):
        corner = tracer.vertex_normals[tracer.triangles.faces[hits.primitive[smooth]]]
        u, v = hits.barycentric[smooth, 0:1], hits.barycentric[smooth, 1:2]
        mixed = (1 - u - v) * corner[:, 0] + u * corner[:, 1] + v * corner[:, 2]
        mixed /= np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-6)
        mixed[np.einsum("ij,ij->i", mixed, hits.normal[smooth]) < 0] *= -1
        normals[smooth] = mixed
    return normals


def expose(
    radiance: NDArray[np.float32], sky: NDArray[np.bool_], light: Light, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """(H, W, 3) linear radiance -> uint8 RGB: automatic exposure on what is not sky, lens blur, gain noise, gamma."""
    import cv2

    luminance = radiance @ np.array([0.21, 0.72, 0.07], dtype=np.float32)
    ground = luminance[~sky]
    level = float(np.exp(np.log(np.maximum(ground, 1e-3)).mean())) if ground.size else 0.2
    gain = np.float32(0.075 * 2**light.exposure / max(level, 0.02))
    linear = radiance * gain * np.array([light.tint[0], 1.0, light.tint[1]], dtype=np.float32)
    linear = cv2.GaussianBlur(np.minimum(linear, 2.5), (0, 0), float(rng.uniform(0.42, 0.65)))
    shot = rng.standard_normal(linear.shape, dtype=np.float32)
    strength = np.float32(rng.uniform(0.010, 0.030))
    linear += shot * strength * np.sqrt(np.maximum(linear, 0.002))
    # A toe darker than the 1/2.2 curve: KITTI's cameras leave shadows black.
    clipped = np.clip(linear - 0.007, 0, 1)
    encoded = clipped ** np.float32(1 / 1.9)
    return np.asarray((encoded * 255 + 0.5), dtype=np.uint8)
