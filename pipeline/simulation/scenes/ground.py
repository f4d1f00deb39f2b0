"""The road and the ground beside it, in road coordinates: s along the centre line, d to its left, metres.

Traffic keeps to the right, so the ego lane lies at negative d.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.scenes.mesh import Part, grid_faces, pose
from pipeline.simulation.scenes.surfaces import ASPHALT, MARKING, Surface

S_MIN, S_MAX = -85.0, 150.0


@dataclass(frozen=True)
class Road:
    """A curved, hilly centre line.

    curvature  1/m, at s = 0; it changes by `twist` per metre
    slope      mean rise per metre; waves of `swell` metres height and `wave` metres length lie on it
    roll       rise per metre to the left (the country falls to one side)
    """

    curvature: float
    twist: float
    slope: float
    swell: float
    wave: float
    roll: float

    def heading(self, s: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """Direction of the centre line in radians from +x."""
        return np.asarray(self.curvature * np.asarray(s) + 0.5 * self.twist * np.asarray(s) ** 2)

    @cached_property
    def _centre_line(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """s, x, y of the centre line, metre by metre; s = 0 lies at the origin."""
        nodes = np.arange(S_MIN - 50, S_MAX + 50, 1.0)
        heading = self.heading(nodes + 0.5)
        x = np.concatenate([[0], np.cumsum(np.cos(heading))])[:-1]
        y = np.concatenate([[0], np.cumsum(np.sin(heading))])[:-1]
        zero = int(-nodes[0])
        return nodes, x - x[zero], y - y[zero]

    def plan(self, s: NDArray[np.float64], d: NDArray[np.float64]) -> NDArray[np.float64]:
        """(..., 2) world x y of road coordinates."""
        nodes, x, y = self._centre_line
        at = self.heading(s)
        return np.stack([np.interp(s, nodes, x) - d * np.sin(at), np.interp(s, nodes, y) + d * np.cos(at)], axis=-1)

    def height(self, s: NDArray[np.float64] | float, d: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """World z of the road's own plane (without kerbs)."""
        s, d = np.asarray(s, dtype=np.float64), np.asarray(d, dtype=np.float64)
        camber = -0.015 * np.minimum(np.abs(d), 6.0)
        return self.slope * s + self.swell * np.sin(2 * np.pi * s / self.wave) + self.roll * d + camber

    def normal(self, s: float, d: float) -> NDArray[np.float64]:
        """(3,) upward unit normal of the road surface in the world."""
        along = float(self.height(s + 1.0, d) - self.height(s - 1.0, d)) / 2
        across = float(self.height(s, d + 0.8) - self.height(s, d - 0.8)) / 1.6
        at = float(self.heading(s))
        gradient = along * np.array([np.cos(at), np.sin(at)]) + across * np.array([-np.sin(at), np.cos(at)])
        vector = np.array([-gradient[0], -gradient[1], 1.0])
        return np.asarray(vector / np.linalg.norm(vector))


@dataclass(frozen=True)
class Band:
    """A strip of ground between two distances from the centre line, with heights above the road's plane there."""

    inner: float
    outer: float
    low: float
    high: float
    surface: Surface


@dataclass(frozen=True)
class Ground:
    """Road, its bands (by d, ascending, gapless) and the crossings where everything is at road level.

    crossings  (s_from, s_to) stretches without kerbs
    """

    road: Road
    bands: tuple[Band, ...]
    crossings: tuple[tuple[float, float], ...] = ()

    def lift(self, s: float, d: float) -> float:
        """Height of the ground above the road's plane."""
        if any(start <= s <= end for start, end in self.crossings):
            return 0.0
        for band in self.bands:
            if band.inner <= d <= band.outer:
                share = (d - band.inner) / max(band.outer - band.inner, 1e-6)
                return band.low + share * (band.high - band.low)
        return 0.0

    def point(self, s: float, d: float) -> NDArray[np.float64]:
        """(3,) world position of the ground's surface."""
        x, y = self.road.plan(np.array(s), np.array(d))
        return np.array([x, y, float(self.road.height(s, d)) + self.lift(s, d)])

    def place(self, s: float, d: float, yaw: float = 0.0, tilted: bool = False) -> NDArray[np.float64]:
        """(4, 4) T_world_object of a thing standing here, `yaw` from the road's direction; tilted: with the slope."""
        x, y, z = self.point(s, d)
        up = self.road.normal(s, d) if tilted else np.array([0.0, 0.0, 1.0])
        return pose(x, y, z, float(self.road.heading(s)) + yaw, up)

    def parts(self, rng: np.random.Generator) -> list[Part]:
        """The ground as meshes, one per band."""
        stations = np.unique(np.concatenate([np.arange(S_MIN, S_MAX + 1, 2.5), *[np.array(c) for c in self.crossings]]))
        result = []
        for band in self.bands:
            columns = int(np.clip((band.outer - band.inner) / 2.5, 1, 24)) + 1
            d = np.linspace(band.inner, band.outer, columns)
            lift = np.interp(d, [band.inner, band.outer], [band.low, band.high])
            open_at = np.zeros(len(stations), dtype=bool)
            for start, end in self.crossings:
                open_at |= (stations >= start) & (stations <= end)
            result += self._band(stations, d, lift, open_at, band.surface, rng)
        return result

    def _band(
        self, s: NDArray[np.float64], d: NDArray[np.float64], lift: NDArray[np.float64], open_at: NDArray[np.bool_],
        surface: Surface, rng: np.random.Generator,
    ) -> list[Part]:  # fmt: skip
        grid_s, grid_d = np.meshgrid(s, d, indexing="ij")
        rise = np.where(open_at[:, None], 0.0, lift[None])
        if len(d) > 5:  # wide open ground is never flat; its seams stay where the neighbours are
            bumps = rng.normal(0, 0.035, rise.shape)
            bumps[:, [0, -1]] = 0
            rise = rise + np.where(open_at[:, None], 0, bumps)
        z = self.road.height(grid_s, grid_d) + rise
        vertices = np.concatenate([self.road.plan(grid_s, grid_d), z[..., None]], axis=-1).reshape(-1, 3)
        faces = grid_faces(len(s), len(d)).reshape(len(s) - 1, -1, 3)
        crossing = open_at[:-1] & open_at[1:]
        pieces = [Part(vertices, faces[~crossing].reshape(-1, 3)[:, ::-1], surface)]
        if crossing.any():
            pieces.append(Part(vertices, faces[crossing].reshape(-1, 3)[:, ::-1], ASPHALT))
        return pieces

    def strip(
        self, s_from: float, s_to: float, d_from: float, d_to: float, surface: Surface, lift: float = 0.008
    ) -> Part:
        """A thin layer on the ground: lane marking, patch, contact shadow."""
        s = np.linspace(s_from, s_to, max(2, int((s_to - s_from) / 3) + 2))
        d = np.linspace(d_from, d_to, max(2, int((d_to - d_from) / 2) + 2))
        grid_s, grid_d = np.meshgrid(s, d, indexing="ij")
        # Stays above the coarser ground mesh where the road is curved over its length.
        z = self.road.height(grid_s, grid_d) + self.lift(0.5 * (s_from + s_to), 0.5 * (d_from + d_to)) + lift
        vertices = np.concatenate([self.road.plan(grid_s, grid_d), z[..., None]], axis=-1).reshape(-1, 3)
        return Part(vertices, grid_faces(len(s), len(d))[:, ::-1], surface)

    def dashes(self, d: float, dash: float, gap: float, width: float = 0.12) -> list[Part]:
        """A broken lane marking along the whole road; gap 0 gives a full line."""
        starts: Sequence[float] = np.arange(S_MIN + 5, S_MAX - 12, dash + gap).tolist()
        clear = [s for s in starts if not any(a - dash < s < b for a, b in self.crossings)]
        return [self.strip(s, s + dash, d - width / 2, d + width / 2, MARKING) for s in clear]


def draw_road(rng: np.random.Generator, straight: bool) -> Road:
    """A road at random: bends of about 100 m radius and more, slopes up to about 4 %."""
    bend = 0.0018 if straight else 0.006
    return Road(
        curvature=float(rng.normal(0, bend)),
        twist=float(rng.normal(0, bend / 90)),
        slope=float(rng.normal(0, 0.012)),
        swell=float(rng.uniform(0, 0.35)),
        wave=float(rng.uniform(90, 220)),
        roll=float(rng.normal(0, 0.006)),
    )
