"""Back-projection, sigma filter, grid sampling and radius gathering beside compositions of NumPy, SciPy and Open3D.

    OMP_NUM_THREADS=1 taskset -c 0 python -m benchmarks.pointcloud
    OMP_NUM_THREADS=2 taskset -c 0,1 python -m benchmarks.pointcloud

The same four steps on the same frame, alternating in one process. Peers get float32 arithmetic, precomputed rays, and
as many SciPy and Open3D threads as there are cores; ours uses one thread. "equal": the same points in the same order
(first), up to ties (nearest); Open3D anchors its grid at the cloud's corner, so its centroids cannot be compared.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pointcloud_frame import StreetFrame, street_frame
from benchmarks.record import Measure, measure_of, save
from benchmarks.timing import Comparison, compare, format_table, write_table
from pipeline.pointcloud.depth_sampling import back_project_and_sample
from pipeline.pointcloud.grid_sampling import GridSampling
from pipeline.pointcloud.radius_gather import Radii, radius_gather
from pipeline.pointcloud.sigma_filter import SigmaBand, sigma_filter

CELL, NEAR, FAR, SPLIT = 0.2, 0.3, 1.5, 40.0


def ours(frame: StreetFrame, representative: Any) -> np.ndarray:
    """The steps as `augment_frame` calls them."""
    completed, raw = frame.completed, frame.points[:, :3]
    keep = sigma_filter(completed, SigmaBand())
    cloud = back_project_and_sample(completed.depth, frame.calibration, keep, GridSampling(CELL, representative))
    gathered = radius_gather(cloud.points, cloud.look_up(completed.depth), raw, Radii(NEAR, FAR, SPLIT))
    return cloud.points[gathered]


class NumpyRays:
    """Rays of the LiDAR frame, computed once: a peer may keep them between frames of one camera."""

    def __init__(self, frame: StreetFrame) -> None:
        P2, T = frame.calibration.P2, frame.calibration.T_velo_cam
        height, width = frame.truth.shape
        u, v = np.meshgrid((np.arange(width) - P2[0, 2]) / P2[0, 0], (np.arange(height) - P2[1, 2]) / P2[1, 1])
        rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ T[:3, :3].T
        self.rays = rays.astype(np.float32)
        offset = T @ np.array([-P2[0, 3] / P2[0, 0], -P2[1, 3] / P2[1, 1], 0, 1])
        self.offset = offset[:3].astype(np.float32)


def numpy_points(frame: StreetFrame, rays: NumpyRays) -> tuple[np.ndarray, np.ndarray]:
    """Sigma filter and back-projection: (N, 3) points and their depths."""
    c = frame.completed
    keep = (c.depth > 0) & ~((c.sigma > 0.2) & (c.sigma < 0.8) & (c.background - c.foreground >= 3))
    pixels = np.flatnonzero(keep)
    depth = c.depth.reshape(-1)[pixels]
    points = rays.rays[pixels]
    points *= depth[:, None]
    points += rays.offset
    return points, depth


def cell_keys(points: np.ndarray) -> np.ndarray:
    """One int32 per cell; the scene fits into 1024 x 1024 x 1024 cells."""
    cells = np.floor(points * np.float32(1 / CELL)).astype(np.int32)
    return ((cells[:, 0] + 512) << 20) + ((cells[:, 1] + 512) << 10) + (cells[:, 2] + 512)


def numpy_first(points: np.ndarray) -> np.ndarray:
    """Index of the first point of every cell, in order."""
    return np.sort(np.unique(cell_keys(points), return_index=True)[1])


def numpy_nearest(points: np.ndarray) -> np.ndarray:
    """Index of the point nearest to the centroid of every cell, cells in order of appearance."""
    _, first, cell = np.unique(cell_keys(points), return_index=True, return_inverse=True)
    count = np.bincount(cell)
    distance = np.zeros(len(points))
    for axis in range(3):
        centroid = np.bincount(cell, weights=points[:, axis]) / count
        distance += (points[:, axis] - centroid[cell]) ** 2
    smallest = np.full(len(count), np.inf)
    np.minimum.at(smallest, cell, distance)
    candidates = np.flatnonzero(distance == smallest[cell])[::-1]
    nearest = np.empty(len(count), np.int64)
    nearest[cell[candidates]] = candidates
    return nearest[np.argsort(first)]


def scipy_gather(points: np.ndarray, depth: np.ndarray, raw: np.ndarray, workers: int) -> np.ndarray:
    """Mask by cKDTree, the faster way of building it, one query per radius."""
    from scipy.spatial import cKDTree

    tree = cKDTree(raw, balanced_tree=False, compact_nodes=False)
    mask = np.zeros(len(points), bool)
    near = depth <= SPLIT
    for group, radius in ((near, NEAR), (~near, FAR)):
        # The bound is exclusive in SciPy: one step up makes it inclusive.
        limit = np.nextafter(radius, np.inf)
        mask[group] = np.isfinite(tree.query(points[group], distance_upper_bound=limit, workers=workers)[0])
    return mask


def open3d_gather(points: np.ndarray, depth: np.ndarray, raw: np.ndarray) -> np.ndarray:
    """Mask by Open3D's nearest neighbour search."""
    import open3d.core as o3c

    search = o3c.nns.NearestNeighborSearch(o3c.Tensor(raw))
    search.knn_index()
    distance = search.knn_search(o3c.Tensor(points), 1)[1].numpy()[:, 0]
    return distance <= np.where(depth <= SPLIT, np.float32(NEAR**2), np.float32(FAR**2))


def open3d_centroids(points: np.ndarray) -> np.ndarray:
    """(M, 3) means of cells, legacy Open3D (faster here than its tensor version)."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    return np.asarray(cloud.voxel_down_sample(CELL).points).astype(np.float32)


def peers(frame: StreetFrame, representative: str, workers: int) -> dict[str, Callable[[], np.ndarray]]:
    """Whole compositions for one kind of representative."""
    rays, raw = NumpyRays(frame), np.ascontiguousarray(frame.points[:, :3])
    T_cam_velo = frame.calibration.T_cam_velo.astype(np.float32)
    pick = {"first": numpy_first, "nearest": numpy_nearest}

    def sampled() -> tuple[np.ndarray, np.ndarray]:
        points, depth = numpy_points(frame, rays)
        if representative == "centroid":
            centroids = open3d_centroids(points)
            return centroids, centroids @ T_cam_velo[2, :3] + T_cam_velo[2, 3]
        chosen = pick[representative](points)
        return points[chosen], depth[chosen]

    def with_scipy() -> np.ndarray:
        points, depth = sampled()
        return points[scipy_gather(points, depth, raw, workers)]

    def with_open3d() -> np.ndarray:
        points, depth = sampled()
        return points[open3d_gather(points, depth, raw)]

    grid = "Open3D" if representative == "centroid" else "NumPy"
    return {f"{grid} grid + SciPy": with_scipy, f"{grid} grid + Open3D": with_open3d}


def agree(mine: np.ndarray, theirs: np.ndarray) -> bool:
    """The same cloud up to 5 % of points: float32 rounds differently, which decides ties of two-point cells."""
    ours_set = {tuple(point) for point in np.round(mine, 3).tolist()}
    their_set = {tuple(point) for point in np.round(theirs, 3).tolist()}
    return len(ours_set ^ their_set) <= 0.05 * max(len(ours_set), 1)


def run(repeats: int) -> list[Comparison]:
    """One row per kind of representative."""
    frame = street_frame()
    workers = int(os.environ.get("OMP_NUM_THREADS", "1"))
    rows = []
    for representative in ("nearest", "first", "centroid"):
        check = None if representative == "centroid" else agree
        others = peers(frame, representative, workers)
        rows.append(
            compare(f"four steps, {representative}", partial(ours, frame, representative), others, repeats, check)
        )
    return rows


def temporary_memory() -> float:
    """Peak of NumPy's allocations in megabytes during ours, inputs not counted, output included."""
    import tracemalloc

    frame = street_frame()
    ours(frame, "nearest")
    tracemalloc.start()
    result = ours(frame, "nearest")
    peak = tracemalloc.get_traced_memory()[1] - result.nbytes
    tracemalloc.stop()
    return peak / 1e6


def main() -> None:
    """Print the table; with --out also write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--out", type=Path, default=None, help="Markdown file to write")
    parser.add_argument("--json", help="write the figures to this file")
    arguments = parser.parse_args()
    rows = run(arguments.repeats)
    print(format_table(rows))
    memory = temporary_memory()
    print(f"temporary memory of ours: {memory:.1f} MB")
    save(arguments.json, [*map(measure_of, rows), Measure("four steps, temporary memory", memory, "MB")])
    if arguments.out is not None:
        write_table(rows, arguments.out)


if __name__ == "__main__":
    main()
