"""Triangle soup with a surface and an instance per triangle, and the small shapes everything is built from.

Local frames are x forward, y left, z up in metres; an object stands on z = 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.scenes.surfaces import Surface

Vertices = NDArray[np.float64]
Faces = NDArray[np.int64]
Floats = Sequence[float] | NDArray[np.float64]


@dataclass(frozen=True)
class Part:
    """Triangles of one material: vertices (V, 3) metres, faces (F, 3) indices."""

    vertices: Vertices
    faces: Faces
    surface: Surface

    def moved(self, matrix: NDArray[np.float64]) -> Part:
        """The part under a (4, 4) transform."""
        return Part(self.vertices @ matrix[:3, :3].T + matrix[:3, 3], self.faces, self.surface)

    def scaled(self, x: float, y: float, z: float) -> Part:
        """The part stretched along its axes."""
        return Part(self.vertices * np.array([x, y, z]), self.faces, self.surface)

    def at(self, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> Part:
        """The part turned by `yaw` radians about z, then moved."""
        return self.moved(pose(x, y, z, yaw))


def pose(x: float, y: float, z: float, yaw: float, up: Floats = (0.0, 0.0, 1.0)) -> NDArray[np.float64]:
    """(4, 4) transform of a body standing at x, y, z with heading `yaw` and its z axis along `up`."""
    z_axis = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    heading = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    x_axis = heading - z_axis * (heading @ z_axis)
    x_axis /= np.linalg.norm(x_axis)
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack([x_axis, np.cross(z_axis, x_axis), z_axis])
    matrix[:3, 3] = x, y, z
    return matrix


def extent(parts: Iterable[Part]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Smallest and largest x y z of all parts."""
    lows, highs = zip(*((part.vertices.min(axis=0), part.vertices.max(axis=0)) for part in parts), strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def joined(parts: Sequence[Part]) -> Part:
    """Parts of one material as one part."""
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = [part.faces + offset for part, offset in zip(parts, offsets, strict=True)]
    return Part(np.concatenate([part.vertices for part in parts]), np.concatenate(faces), parts[0].surface)


def fitted(parts: list[Part], length: float, width: float, height: float) -> list[Part]:
    """The parts stretched and shifted so that together they fill exactly this box, standing on z = 0."""
    low, high = extent(parts)
    factor = np.array([length, width, height]) / (high - low)
    centre = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    return [Part((part.vertices - centre) * factor, part.faces, part.surface) for part in parts]


_BOX_FACES = np.array(
    [0, 2, 1, 1, 2, 3, 4, 5, 6, 5, 7, 6, 0, 1, 4, 1, 5, 4, 2, 6, 3, 3, 6, 7, 0, 4, 2, 2, 4, 6, 1, 3, 5, 3, 7, 5]
).reshape(-1, 3)
_UNIT_BOX = np.array([[x, y, z] for z in (0, 1) for y in (-0.5, 0.5) for x in (-0.5, 0.5)], dtype=np.float64)


def box(length: float, width: float, height: float, surface: Surface, z: float = 0.0) -> Part:
    """A box centred on x = y = 0 whose underside lies at `z`."""
    return Part(_UNIT_BOX * (length, width, height) + (0, 0, z), _BOX_FACES, surface)


def boxes(centres: NDArray[np.float64], size: Floats, surface: Surface) -> Part:
    """Equal boxes at (N, 3) bottom centres."""
    count = len(centres)
    vertices = (_UNIT_BOX * np.asarray(size))[None] + np.asarray(centres)[:, None]
    faces = _BOX_FACES[None] + 8 * np.arange(count)[:, None, None]
    return Part(vertices.reshape(-1, 3), faces.reshape(-1, 3), surface)


def grid_faces(rows: int, columns: int, closed: bool = False) -> Faces:
    """(2 (rows-1) columns', 3) faces of a vertex grid in row-major order; `closed` joins last and first column."""
    last = columns if closed else columns - 1
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(last), indexing="ij")
    right = (j + 1) % columns
    a, b, c, d = i * columns + j, i * columns + right, (i + 1) * columns + j, (i + 1) * columns + right
    return np.stack([np.stack([a, c, b], -1), np.stack([b, c, d], -1)], axis=2).reshape(-1, 3)


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) cross product of (N, 3) rows; numpy's own is several times slower on short arrays."""
    return np.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=-1,
    )


def tube(path: NDArray[np.float64], radii: NDArray[np.float64], sides: int, surface: Surface) -> Part:
    """A closed pipe along (N, 3) points with (N,) radii."""
    direction = np.concatenate([path[1:2] - path[:1], path[2:] - path[:-2], path[-1:] - path[-2:-1]])
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    helper = np.where(np.abs(direction[:, 2:3]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = _cross(direction, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = _cross(direction, first)
    angle = np.arange(sides) * (2 * np.pi / sides)
    ring = first[:, None] * np.cos(angle)[None, :, None] + second[:, None] * np.sin(angle)[None, :, None]
    vertices = (path[:, None] + ring * radii[:, None, None]).reshape(-1, 3)
    count = len(vertices)
    caps = [[count, k, (k + 1) % sides] for k in range(sides)]
    caps += [[count + 1, count - sides + (k + 1) % sides, count - sides + k] for k in range(sides)]
    faces = np.concatenate([grid_faces(len(path), sides, closed=True), np.array(caps)])
    return Part(np.concatenate([vertices, path[:1], path[-1:]]), faces, surface)


def cylinder(radius: float, height: float, surface: Surface, sides: int = 10, top: float | None = None) -> Part:
    """An upright cylinder on z = 0; `top` is the upper radius of a cone frustum."""
    path = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, height]])
    return tube(path, np.array([radius, radius if top is None else top]), sides, surface)


def ellipsoid(radii: Floats, centre: Floats, surface: Surface, rows: int = 7, sides: int = 10) -> Part:
    """An ellipsoid of latitude rings."""
    polar = np.linspace(0.02, np.pi - 0.02, rows)
    turn = np.arange(sides) * (2 * np.pi / sides)
    unit = np.stack(
        [
            np.sin(polar)[:, None] * np.cos(turn),
            np.sin(polar)[:, None] * np.sin(turn),
            np.repeat(np.cos(polar)[:, None], sides, axis=1),
        ],
        axis=-1,
    ).reshape(-1, 3)
    return Part(unit * np.asarray(radii) + np.asarray(centre), grid_faces(rows, sides, closed=True), surface)


def quad(corners: Sequence[Sequence[float]], surface: Surface) -> Part:
    """A flat four-cornered face, corners in turn."""
    return Part(np.array(corners, dtype=np.float64), np.array([[0, 1, 2], [0, 2, 3]]), surface)


def cards(centres: NDArray[np.float64], sizes: NDArray[np.float64], rng: np.random.Generator, surface: Surface) -> Part:
    """Square cards of (N,) edge lengths at (N, 3) centres, turned at random: leaves."""
    count = len(centres)
    u = rng.normal(size=(count, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = _cross(u, rng.normal(size=(count, 3)))
    v /= np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)
    half = sizes[:, None] / 2
    corners = np.stack(
        [centres - half * u, centres + half * v * 0.7, centres + half * u, centres - half * v * 0.7], axis=1
    )
    faces = np.array([[0, 1, 2], [0, 2, 3]])[None] + 4 * np.arange(count)[:, None, None]
    return Part(corners.reshape(-1, 3), faces.reshape(-1, 3), surface)


@dataclass(frozen=True)
class TriangleScene:
    """Everything of a moment: vertices (V, 3) float32, faces (F, 3) uint32, surface (F,) int32, instance (F,) int32.

    surfaces  the materials that `surface` numbers; instance 0 is the static world, k the object with track k
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    surface: NDArray[np.int32]
    instance: NDArray[np.int32]
    surfaces: list[Surface]


def assemble(groups: Iterable[tuple[int, Iterable[Part]]]) -> TriangleScene:
    """Joins (instance, parts) groups into one triangle scene."""
    numbers: dict[Surface, int] = {}
    vertices, faces, surface, instance = [], [], [], []
    offset = 0
    for identity, parts in groups:
        for part in parts:
            if part.surface not in numbers:
                numbers[part.surface] = len(numbers)
            vertices.append(part.vertices)
            faces.append(part.faces + offset)
            surface.append(np.full(len(part.faces), numbers[part.surface], dtype=np.int32))
            instance.append(np.full(len(part.faces), identity, dtype=np.int32))
            offset += len(part.vertices)
    return TriangleScene(
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(faces).astype(np.uint32),
        np.concatenate(surface),
        np.concatenate(instance),
        list(numbers),
    )
