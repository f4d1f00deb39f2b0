"""Ray casting into a triangle scene with Open3D (Embree), one thread per process."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.scenes.mesh import TriangleScene
from pipeline.simulation.scenes.surfaces import SurfaceTable


@dataclass(frozen=True)
class Hits:
    """First hits of N rays.

    reach      (N,) float32: multiples of the ray's direction vector, inf where nothing is hit
    primitive  (N,) int64 triangle number, -1 where nothing is hit
    normal     (N, 3) float32 unit normal of the triangle, turned towards the ray's origin
    barycentric (N, 2) float32
    """

    reach: NDArray[np.float32]
    primitive: NDArray[np.int64]
    normal: NDArray[np.float32]
    barycentric: NDArray[np.float32]


class Tracer:
    """A triangle scene with its acceleration structure and look-ups by triangle.

    Not picklable: each process builds its own.
    """

    def __init__(self, triangles: TriangleScene) -> None:
        import open3d as o3d

        self.triangles = triangles
        self.table = SurfaceTable.of(triangles.surfaces)
        tensor: Any = o3d.core.Tensor
        self._tensor = tensor
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(tensor(triangles.vertices), tensor(triangles.faces))

    @cached_property
    def vertex_normals(self) -> NDArray[np.float32]:
        """(V, 3) float32 smooth normals."""
        from pipeline.simulation.shading import vertex_normals

        return np.asarray(vertex_normals(self.triangles.vertices, self.triangles.faces))

    def cast(self, origin: NDArray[np.floating], direction: NDArray[np.floating]) -> Hits:
        """First hits of rays from (3,) or (N, 3) origins in (N, 3) directions, world frame."""
        rays = np.empty((len(direction), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = origin, direction
        answer = self._scene.cast_rays(self._tensor(rays), nthreads=1)
        primitive = answer["primitive_ids"].numpy().astype(np.int64)
        primitive[primitive == 0xFFFFFFFF] = -1
        normal = answer["primitive_normals"].numpy()
        away = np.einsum("ij,ij->i", normal, rays[:, 3:]) > 0
        normal[away] *= -1
        return Hits(answer["t_hit"].numpy(), primitive, normal, answer["primitive_uvs"].numpy())

    def blocked(self, origin: NDArray[np.floating], direction: NDArray[np.floating]) -> NDArray[np.bool_]:
        """(N,) True where anything lies in (3,) `direction` of the (N, 3) origins."""
        rays = np.empty((len(origin), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = origin, direction
        found = self._scene.test_occlusions(self._tensor(rays), nthreads=1).numpy()
        return np.asarray(found, dtype=bool)

    def surface_of(self, primitive: NDArray[np.int64]) -> NDArray[np.int32]:
        """(N,) surface number, -1 for no hit."""
        return np.where(primitive < 0, -1, self.triangles.surface[primitive]).astype(np.int32)

    def instance_of(self, primitive: NDArray[np.int64]) -> NDArray[np.int32]:
        """(N,) instance number, 0 for the static world and for no hit."""
        return np.where(primitive < 0, 0, self.triangles.instance[primitive]).astype(np.int32)
