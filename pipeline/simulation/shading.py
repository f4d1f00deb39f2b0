"""Colour of what a ray hits: procedural textures, sun, sky light and reflections, compiled with numba.

All functions work in linear light. Noise is value noise on an integer lattice, so that the same place of the world has
the same colour in every picture; detail finer than a pixel's footprint is left out (no aliasing far away).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pipeline.simulation.scenes.surfaces import Texture

_ASPHALT, _PAVING, _GRASS, _PLASTER = (
    int(Texture.ASPHALT),
    int(Texture.PAVING),
    int(Texture.GRASS),
    int(Texture.PLASTER),
)
_BRICK, _LEAVES, _BARK, _GLASS, _PAINT = (
    int(Texture.BRICK),
    int(Texture.LEAVES),
    int(Texture.BARK),
    int(Texture.GLASS),
    int(Texture.PAINT),
)
_TILES, _BOARDS, _SOIL, _CLOTH = int(Texture.TILES), int(Texture.BOARDS), int(Texture.SOIL), int(Texture.CLOTH)
_STRIPES, _BILLBOARD, _PLAIN = int(Texture.STRIPES), int(Texture.BILLBOARD), int(Texture.PLAIN)


@njit(cache=True)
def _hash(x: int, y: int, z: int) -> float:
    """A number in [0, 1) for a lattice point (integer mixing after Wellons' low-bias 32-bit hash)."""
    h = (np.uint32(x & 0xFFFFFFFF) * np.uint32(0x9E3779B1)) ^ (np.uint32(y & 0xFFFFFFFF) * np.uint32(0x85EBCA77))
    h = np.uint32(h ^ (np.uint32(z & 0xFFFFFFFF) * np.uint32(0xC2B2AE3D)))
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x7FEB352D))
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x846CA68B))
    h = np.uint32(h ^ (h >> np.uint32(16)))
    return float(h) / 4294967296.0


@njit(cache=True)
def _noise(x: float, y: float, z: float) -> float:
    """Value noise in [0, 1] with a lattice of 1."""
    ix, iy, iz = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    fx, fy, fz = x - ix, y - iy, z - iz
    fx, fy, fz = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy), fz * fz * (3 - 2 * fz)
    value = 0.0
    for k in range(8):
        a, b, c = k & 1, (k >> 1) & 1, (k >> 2) & 1
        weight = (fx if a else 1 - fx) * (fy if b else 1 - fy) * (fz if c else 1 - fz)
        value += weight * _hash(ix + a, iy + b, iz + c)
    return value


@njit(cache=True)
def _fractal(x: float, y: float, z: float, wavelength: float, octaves: int, footprint: float) -> float:
    """Sum of noise octaves in [0, 1], mean 0.5, without waves shorter than twice the footprint."""
    value, weight, total = 0.0, 1.0, 0.0
    for octave in range(octaves):
        fade = min(1.0, max(0.0, wavelength / (2 * footprint) - 0.5))
        if fade > 0:
            value += weight * fade * (_noise(x / wavelength, y / wavelength, z / wavelength + 17.3 * octave) - 0.5)
        total += weight
        weight *= 0.6
        wavelength *= 0.45
    return 0.5 + value / total * 1.6


@njit(cache=True)
def _step(value: float, edge: float, width: float) -> float:
    """0 below `edge`, 1 above, with a ramp of `width`."""
    return min(1.0, max(0.0, (value - edge) / max(width, 1e-6) + 0.5))


@njit(cache=True)
def _joints(
    u: float, v: float, long: float, high: float, shift: float, joint: float, footprint: float
) -> tuple[float, float]:
    """(weight of the joint, hash of the stone) in a running bond."""
    row = np.floor(v / high)
    along = u / long + shift * (row % 2)
    column = np.floor(along)
    du, dv = abs(along - column - 0.5) * long, abs(v / high - row - 0.5) * high
    edge = max(du - long / 2, dv - high / 2) + joint
    visible = min(1.0, joint * 3 / max(footprint, 1e-6))
    return _step(edge, 0.0, max(footprint, 0.3 * joint)) * visible, _hash(int(column), int(row), 7)


@njit(cache=True)
def _pattern(
    kind: int, p: np.ndarray, n: np.ndarray, scale: float, footprint: float, primitive: int
) -> tuple[float, float]:
    """(weight of the second colour, brightness factor) of a texture at world point p with normal n."""
    x, y, z = p[0], p[1], p[2]
    if abs(n[2]) > 0.75:
        u, v = x, y
    else:
        flat = max(np.sqrt(n[0] * n[0] + n[1] * n[1]), 1e-6)
        u, v = (-n[1] * x + n[0] * y) / flat, z
    if kind == _ASPHALT:
        grain = _fractal(x, y, z, 0.05, 3, footprint)
        wide = _fractal(x, y, z, 2.5, 4, footprint)
        return min(1.0, max(0.0, 0.9 * wide - 0.15)), max(0.2, 1.0 + 2.8 * (grain - 0.5))
    if kind == _PAVING:
        joint, stone = _joints(u, v, scale, scale, 0.5, 0.008, footprint)
        return max(joint, 0.35 * stone), 0.75 + 0.5 * _fractal(x, y, z, 0.9, 4, footprint)
    if kind == _GRASS:
        fine = _fractal(x, y, z, 0.10, 2, footprint)
        wide = _fractal(x, y, z, 3.0, 4, footprint)
        return min(1.0, max(0.0, 1.5 * wide - 0.45)), max(0.25, 0.15 + 1.7 * fine)
    if kind == _SOIL:
        return _fractal(x, y, z, 1.2, 4, footprint), 0.4 + 1.2 * _fractal(x, y, z, 0.12, 2, footprint)
    if kind == _PLASTER:
        stain = _fractal(x, y, 0.35 * z, scale, 3, footprint)
        return min(1.0, max(0.0, 1.2 * stain - 0.45)), 0.93 + 0.14 * _fractal(x, y, z, 0.08, 2, footprint)
    if kind == _BRICK:
        joint, stone = _joints(u, v, scale, 0.3 * scale, 0.5, 0.012, footprint)
        return joint, 0.65 + 0.7 * stone * min(1.0, scale / max(3 * footprint, 1e-6)) + 0.2 * _fractal(
            x, y, z, 1.5, 2, footprint
        )
    if kind == _TILES:
        joint, stone = _joints(u, v, 0.8 * scale, scale, 0.5, 0.03, footprint)
        return max(0.7 * joint, 0.25 * stone), 0.7 + 0.6 * _fractal(x, y, z, 2.0, 3, footprint)
    if kind == _LEAVES:
        leaf = _hash(primitive >> 1, 3, 5)
        return min(1.0, leaf * 0.7 + 0.3 * _fractal(x, y, z, scale, 2, footprint)), 0.45 + 0.7 * leaf + 0.35 * _fractal(
            x, y, z, scale, 2, footprint
        )
    if kind == _BARK:
        return _fractal(3 * x, 3 * y, 0.35 * z, scale * 2, 3, footprint), 0.6 + 0.8 * _fractal(
            x, y, z, 0.3, 2, footprint
        )
    if kind == _BOARDS:
        board = u / scale if scale < 0.2 else v / scale
        crack = abs(board - np.floor(board) - 0.5) * 2
        return _step(crack, 0.92, footprint / scale * 2) * min(
            1.0, scale / max(2 * footprint, 1e-6)
        ), 0.8 + 0.4 * _hash(int(np.floor(board)), 1, 2)
    if kind == _CLOTH:
        return 0.0, 0.6 + 0.8 * _fractal(x, y, z, scale, 3, footprint)
    if kind == _STRIPES:
        band = (u + v) / scale
        return 1.0 if band - np.floor(band) > 0.62 else 0.0, 1.0
    if kind == _BILLBOARD:
        return _step(_fractal(u, v, 0.0, scale, 3, footprint), 0.55, 0.03), 0.9 + 0.2 * _noise(u, v, 3.0)
    if kind in (_PAINT, _GLASS):
        return 0.0, 1.0
    return 0.35 * _fractal(x, y, z, max(scale, 0.05), 3, footprint), 0.8 + 0.4 * _fractal(x, y, z, 0.25, 3, footprint)


@njit(cache=True)
def _sky(d: np.ndarray, zenith: np.ndarray, horizon: np.ndarray, clouds: float, out: np.ndarray) -> None:
    """Radiance of the sky in a unit direction; below the horizon the mirror image of a street."""
    up = d[2]
    if up <= 0.0:
        for c in range(3):
            out[c] = 0.20 * horizon[c] * (1 + max(up, -0.6))
        return
    blend = min(1.0, up * 2.2) ** 0.6
    cover = _fractal(d[0] / (up + 0.12) * 0.8, d[1] / (up + 0.12) * 0.8, 0.5, 1.3, 4, 0.01)
    white = _step(cover, 1.05 - 0.9 * clouds, 0.35)
    for c in range(3):
        clear = horizon[c] * (1 - blend) + zenith[c] * blend
        out[c] = clear * (1 - white) + white * (0.80 + 0.35 * cover)


@njit(cache=True)
def shade(
    points: np.ndarray, normals: np.ndarray, rays: np.ndarray, distance: np.ndarray, surface: np.ndarray,
    primitive: np.ndarray, lit: np.ndarray, texture: np.ndarray, colour: np.ndarray, second: np.ndarray,
    scale: np.ndarray, gloss: np.ndarray, sun: np.ndarray, direct: float, ambient: float, zenith: np.ndarray,
    horizon: np.ndarray, clouds: float, pixel: float,
) -> np.ndarray:  # fmt: skip
    """(N, 3) float32 linear radiance of N rays.

    points, normals, rays  (N, 3) float32: hit in the world, unit normal towards the viewer, unit viewing direction
    distance  (N,) metres; surface (N,) material number or -1 for the sky; primitive (N,) triangle number
    lit       (N,) bool, the sun is seen from the hit
    texture .. gloss  columns of the SurfaceTable; sun .. clouds: the Light; pixel: angle of a pixel in radians
    """
    count = len(distance)
    radiance = np.empty((count, 3), dtype=np.float32)
    mirror, seen = np.empty(3), np.empty(3)
    for i in range(count):
        d, s = rays[i].astype(np.float64), surface[i]
        if s < 0:
            _sky(d, zenith, horizon, clouds, seen)
            radiance[i] = seen * 2.0
            continue
        n, p = normals[i].astype(np.float64), points[i].astype(np.float64)
        facing = max(-(n[0] * d[0] + n[1] * d[1] + n[2] * d[2]), 0.03)
        footprint = distance[i] * pixel / np.sqrt(facing)
        weight, factor = _pattern(texture[s], p, n, scale[s], footprint, primitive[i])
        towards = n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2]
        if texture[s] == _LEAVES:
            towards = 0.3 + 0.5 * abs(towards)
        if texture[s] != _PAINT and texture[s] != _GLASS:
            fine = _fractal(p[0], p[1], p[2], 0.11, 3, footprint)
            factor = max(0.15, factor * (1 + (0.35 if texture[s] == _PLASTER else 1.0) * (fine - 0.5)))
        sunlight = direct * max(towards, 0.0) if lit[i] else 0.0
        skylight = ambient * (0.55 + 0.45 * n[2])
        for c in range(3):
            albedo = (colour[s, c] * (1 - weight) + second[s, c] * weight) * factor
            warm = 1.0 if c == 0 else (0.95 if c == 1 else 0.86)
            cool = 0.86 if c == 0 else (0.94 if c == 1 else 1.08)
            radiance[i, c] = albedo * (sunlight * warm + skylight * cool)
        if gloss[s] > 0:
            cosine = -(n[0] * d[0] + n[1] * d[1] + n[2] * d[2])
            mirror[:] = d + 2 * cosine * n
            _sky(mirror, zenith, horizon, clouds, seen)
            # Houses, trees and cars around stand up to a ragged skyline in the mirror image.
            skyline = 0.05 + 0.7 * _noise(2.5 * mirror[0] + 0.2 * p[0], 2.5 * mirror[1] + 0.2 * p[1], 0.5)
            if mirror[2] < skyline:
                dark = 0.10 + 0.35 * _noise(6 * mirror[0] + p[0], 6 * mirror[1] + p[1], 8 * mirror[2])
                for c in range(3):
                    seen[c] = dark * horizon[c]
            fresnel = 0.11 + 0.89 * (1 - min(max(cosine, 0.0), 1.0)) ** 5
            glint = mirror[0] * sun[0] + mirror[1] * sun[1] + mirror[2] * sun[2]
            flash = 9.0 * max(glint, 0.0) ** 220 * direct if lit[i] else 0.0
            for c in range(3):
                radiance[i, c] += gloss[s] * (
                    fresnel * ambient * 1.2 * seen[c] + 0.1 * flash + 0.05 * flash * colour[s, c]
                )
    return radiance


@njit(cache=True)
def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) float32 area-weighted unit normals of the vertices."""
    total = np.zeros((len(vertices), 3))
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = vertices[j, 0] - vertices[i, 0], vertices[j, 1] - vertices[i, 1], vertices[j, 2] - vertices[i, 2]
        bx, by, bz = vertices[k, 0] - vertices[i, 0], vertices[k, 1] - vertices[i, 1], vertices[k, 2] - vertices[i, 2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        for v in (i, j, k):
            total[v, 0] += nx
            total[v, 1] += ny
            total[v, 2] += nz
    result = np.zeros((len(vertices), 3), dtype=np.float32)
    for v in range(len(vertices)):
        length = np.sqrt(total[v, 0] ** 2 + total[v, 1] ** 2 + total[v, 2] ** 2)
        if length > 0:
            result[v] = total[v] / length
    return result
