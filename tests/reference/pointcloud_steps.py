"""Obvious twins of the point-cloud steps: loops and plain NumPy, no hash tables, no blocks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from completion.types import CompletedDepth
from pipeline.geometry.calibration import Calibration


def back_project(depth: NDArray, calibration: Calibration, keep: NDArray) -> tuple[NDArray, NDArray]:
    """Points (N, 3) float32 and pixels (N,): u = P2[0] x / P2[2] x and v = P2[1] x / P2[2] x solved for x and y."""
    P2, T = calibration.P2, calibration.T_velo_cam
    points, pixels = [], []
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if keep[v, u] and depth[v, u] > 0:
                z = float(depth[v, u])
                unknowns = np.array([P2[0, :2] - u * P2[2, :2], P2[1, :2] - v * P2[2, :2]])
                w = P2[2, 2] * z + P2[2, 3]
                x, y = np.linalg.solve(unknowns, [u * w - P2[0, 2] * z - P2[0, 3], v * w - P2[1, 2] * z - P2[1, 3]])
                points.append((T @ [x, y, z, 1])[:3])
                pixels.append(v * depth.shape[1] + u)
    return np.array(points, np.float64).reshape(-1, 3).astype(np.float32), np.array(pixels, np.int64)


def sigma_filter(completed: CompletedDepth, low: float, high: float, gap: float) -> NDArray:
    """Fig. 5.6a as it is printed."""
    smeared = (completed.sigma > low) & (completed.sigma < high) & (completed.background - completed.foreground >= gap)
    return (completed.depth > 0) & ~smeared


def cells_of(points: NDArray, size: float) -> dict[tuple[int, int, int], list[int]]:
    """Members of every cell, cells in order of first appearance."""
    cells: dict[tuple[int, int, int], list[int]] = {}
    for i, point in enumerate(points[:, :3].astype(np.float64) * (1.0 / size)):
        cells.setdefault(tuple(int(np.floor(value)) for value in point), []).append(i)
    return cells


def settled(points: NDArray) -> NDArray:
    """Points rounded to multiples of 2^-26 m."""
    return np.rint(points[:, :3].astype(np.float64) * 2**26) / 2**26


def grid_sample(points: NDArray, size: float, representative: str) -> tuple[NDArray, NDArray]:
    """(M,) indices and (M, 3) points of the representatives."""
    chosen, sampled = [], []
    exact = settled(points)
    for members in cells_of(points, size).values():
        centroid = exact[members].sum(axis=0) / len(members)
        squares = (exact[members] - centroid) ** 2
        distances = squares[:, 0] + squares[:, 1] + squares[:, 2]
        pick = members[int(np.argmin(distances))] if representative == "nearest" else members[0]
        chosen.append(pick)
        sampled.append(centroid.astype(np.float32) if representative == "centroid" else points[pick, :3])
    return np.array(chosen, np.int64), np.array(sampled, np.float32).reshape(-1, 3)


def radius_gather(
    points: NDArray, forward: NDArray, anchors: NDArray, near: float, far: float, split: float
) -> NDArray:
    """Every point against every anchor."""
    mask = np.zeros(len(points), bool)
    for i, point in enumerate(points.astype(np.float64)):
        radius = near if forward[i] <= np.float32(split) else far
        squares = (point - anchors[:, :3].astype(np.float64)) ** 2
        mask[i] = bool((squares[:, 0] + squares[:, 1] + squares[:, 2] <= radius * radius).any())
    return mask


def range_sample(
    points: NDArray, rows: int, az_steps: int, top: float, vertical: float, horizontal: float
) -> Sequence[int]:
    """Nearest point of every azimuth-elevation cell by a loop, ascending indices."""
    best: dict[tuple[int, int], tuple[float, int]] = {}
    for i, (x, y, z) in enumerate(points.astype(np.float64)):
        distance = float(np.sqrt(x * x + y * y + z * z))
        elevation = np.degrees(np.arctan2(z, np.sqrt(x * x + y * y)))
        azimuth = np.degrees(np.arctan2(y, x))
        cell = (
            int(np.floor((top - elevation) * (rows / vertical))),
            int(np.floor((horizontal / 2 - azimuth) * (az_steps / horizontal))),
        )
        if 0 <= cell[0] < rows and 0 <= cell[1] < az_steps and distance > 0:
            best[cell] = min(best.get(cell, (np.inf, -1)), (distance, i))
    return sorted(index for _, index in best.values())


def dilate(mask: NDArray, pixels: int) -> NDArray:
    """A pixel is set when any pixel within a square of +-pixels is."""
    grown = np.zeros_like(mask)
    for v in range(mask.shape[0]):
        for u in range(mask.shape[1]):
            grown[v, u] = mask[max(0, v - pixels) : v + pixels + 1, max(0, u - pixels) : u + pixels + 1].any()
    return grown
