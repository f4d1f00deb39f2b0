"""Point and box operations beside their peers: `python -m benchmarks.ops [--threads 1] [--repeats 11] [--out FILE]`.

Furthest point sampling against fpsample, torch-quickfps and torch-fps (those that are installed), neighbour searches
against SciPy's k-d tree, overlaps against Shapely, gathering and pooling against plain torch.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
import shapely
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.record import measure_of, save
from benchmarks.timing import Comparison, compare, format_table, write_table
from detection import ops
from detection.ops import _torch_points

Float = NDArray[np.float32]


def uniform_cloud(count: int, seed: int = 0) -> Float:
    """Points spread evenly over PointRCNN's input range, camera frame."""
    return np.random.default_rng(seed).uniform([-40, -1, 0], [40, 3, 70], (count, 3)).astype(np.float32)


def lidar_cloud(count: int, seed: int = 0) -> Float:
    """Points as a 64-ring scanner sees them in front of a car: ground 1.73 m below, walls at varying distance."""
    rng = np.random.default_rng(seed)
    azimuth = rng.uniform(-np.pi / 4, np.pi / 4, count)
    elevation = np.deg2rad(rng.choice(np.linspace(-24.8, 2.0, 64), count))
    wall = 30 + 25 * np.sin(9 * azimuth) + 10 * np.sin(31 * azimuth)
    ground = np.where(elevation < 0, 1.73 / np.tan(np.maximum(-elevation, 1e-6)), np.inf)
    distance = np.minimum(wall, ground) + rng.normal(0, 0.02, count)
    points = [distance * np.sin(azimuth), -distance * np.tan(elevation), distance * np.cos(azimuth)]
    return np.stack(points, axis=1).astype(np.float32)


def spreads_out(cloud: Float, samples: NDArray[Any]) -> bool:
    """Whether every sample was, within rounding, the point furthest from those before it, whatever the first one."""
    remaining = np.full(len(cloud), np.inf)
    for k, sample in enumerate(samples):
        if k and remaining[sample] < remaining.max() * (1 - 1e-5):
            return False
        remaining = np.minimum(remaining, ((cloud - cloud[sample]) ** 2).sum(axis=1))
    return True


def sampling_peers(cloud: Float, npoint: int) -> dict[str, Callable[[], NDArray[Any]]]:
    """The samplers that are installed."""
    peers: dict[str, Callable[[], NDArray[Any]]] = {}
    if find_spec("fpsample"):
        import fpsample

        for height in (5, 7):
            peers[f"fpsample bucket h={height}"] = lambda height=height: fpsample.bucket_fps_kdline_sampling(
                cloud, npoint, h=height, start_idx=0
            )
    tensor = torch.from_numpy(cloud)[None]
    if find_spec("torch_quickfps"):
        import torch_quickfps

        peers["torch-quickfps"] = lambda: torch_quickfps.sample_idx(tensor, npoint, start_idx=0)[0].numpy()
    if find_spec("torch_fps"):
        import torch_fps

        valid, start = torch.ones(tensor.shape[:2], dtype=torch.bool), torch.zeros(1, dtype=torch.int64)
        peers["torch-fps"] = lambda: torch_fps.farthest_point_sampling(tensor, valid, npoint, start_idx=start)[
            0
        ].numpy()
    return peers


def bench_sampling(repeats: int) -> list[Comparison]:
    rows = []
    for count in (16384, 50000):
        for label, cloud in (("uniform", uniform_cloud(count)), ("LiDAR", lidar_cloud(count))):
            tensor = torch.from_numpy(cloud)
            rows.append(
                compare(
                    f"furthest points {count} -> 4096, {label}",
                    lambda tensor=tensor: ops.furthest_point_sample(tensor, 4096).numpy(),
                    sampling_peers(cloud, 4096),
                    repeats,
                    lambda ours, theirs, cloud=cloud: spreads_out(cloud, ours) and spreads_out(cloud, theirs),
                )
            )
    return rows


def tree_balls(cloud: Float, centres: Float, radius: float, nsample: int) -> NDArray[np.int64]:
    """Ball query with SciPy: all hits, sorted, cut and padded as the operation asks for."""
    out = np.zeros((len(centres), nsample), np.int64)
    for row, hits in zip(out, cKDTree(cloud).query_ball_point(centres, radius, return_sorted=True), strict=True):
        hits = hits[:nsample]
        row[:] = hits[0] if hits else 0
        row[: len(hits)] = hits
    return out


def mostly_equal(ours: NDArray[Any], theirs: NDArray[Any]) -> bool:
    """Equal but for one row in a thousand: the tree works in float64 and decides boundary cases the other way."""
    return bool((ours != theirs).any(axis=1).mean() < 1e-3)


def bench_neighbours(repeats: int) -> list[Comparison]:
    rows = []
    for count in (16384, 50000):
        cloud = lidar_cloud(count)
        points = torch.from_numpy(cloud)
        centres = points[ops.furthest_point_sample(points, 4096)]
        for radius, nsample in ((0.1, 16), (0.5, 32)):
            arguments = (radius, nsample)
            rows.append(
                compare(
                    f"ball query {count} x 4096, {radius} m, {nsample}",
                    lambda p=points, c=centres, a=arguments: ops.ball_query(p, c, *a).numpy(),
                    {"cKDTree": lambda p=cloud, c=centres, a=arguments: tree_balls(p, c.numpy(), *a)},
                    repeats,
                    mostly_equal,
                )
            )
        rows.append(
            compare(
                f"three nearest {count} of 4096",
                lambda p=points, c=centres: ops.three_nn(p, c)[1].numpy(),
                {
                    "cKDTree": lambda p=cloud, c=centres: cKDTree(c.numpy()).query(p, 3)[1],
                    "torch cdist + topk": lambda p=points, c=centres: (
                        torch.cdist(p, c, compute_mode="donot_use_mm_for_euclid_dist")
                        .topk(3, dim=1, largest=False)
                        .indices.numpy()
                    ),
                },
                repeats,
                mostly_equal,
            )
        )
    return rows


def street_boxes(count: int, seed: int) -> NDArray[np.float64]:
    """Cars in camera form, crowded enough that many overlap."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform([-10, 1, 5], [10, 2, 35], (count, 3))
    size = rng.uniform([1.4, 1.5, 3.5], [1.8, 2.0, 5.0], (count, 3))
    return np.column_stack([centre, size, rng.uniform(-np.pi, np.pi, count)])


def shapely_iou(boxes_a: NDArray[np.float64], boxes_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bird's-eye IoU matrix by vectorised Shapely."""

    def outlines(boxes: NDArray[np.float64]) -> Any:
        along = boxes[:, 5:6] / 2 * [1, -1, -1, 1]
        across = boxes[:, 4:5] / 2 * [1, 1, -1, -1]
        cos, sin = np.cos(boxes[:, 6:]), np.sin(boxes[:, 6:])
        x, z = boxes[:, 0:1] + along * cos + across * sin, boxes[:, 2:3] - along * sin + across * cos
        return shapely.polygons(np.stack([x, z], axis=-1))

    a, b = outlines(boxes_a)[:, None], outlines(boxes_b)[None]
    shared = shapely.area(shapely.intersection(a, b))
    return shared / (shapely.area(a) + shapely.area(b) - shared)


def bench_boxes(repeats: int) -> list[Comparison]:
    a, b = street_boxes(200, 1), street_boxes(200, 2)
    # The near band of PointRCNN's proposals in training: budget, threshold, boxes kept.
    proposals = street_boxes(6300, 3), np.random.default_rng(4).normal(size=6300), 0.85, 358
    return [
        compare(
            "rotated IoU from above, 200 x 200",
            lambda: ops.iou_bev(a, b),
            {"Shapely": lambda: shapely_iou(a, b)},
            min(repeats, 5),
            lambda ours, theirs: bool(np.abs(ours - theirs).max() < 1e-12),
        ),
        compare("rotated NMS, 6300 boxes, 0.85, 358 kept", lambda: ops.nms_rotated(*proposals), {}, repeats),
        compare("aligned NMS, 6300 boxes, 0.85, 358 kept", lambda: ops.nms_axis_aligned(*proposals), {}, repeats),
    ]


def bench_features(repeats: int) -> list[Comparison]:
    generator = torch.Generator().manual_seed(0)
    points = torch.from_numpy(lidar_cloud(16384))
    centres = points[ops.furthest_point_sample(points, 4096)]
    coarse = torch.randn(1, 256, 4096, generator=generator)
    distance, index = (part[None] for part in ops.three_nn(points, centres))
    weight = ops.interpolation_weights(distance)
    balls = ops.ball_query(centres, centres[:1024].contiguous(), 1.0, 32)[None]
    rows = torch.randn(16384, 130, generator=generator)
    rois = torch.cat([centres[:100] + torch.tensor([0, 0.8, 0]), torch.tensor([1.5, 1.6, 4.0, 0.7]).expand(100, 4)], 1)

    def close(ours: torch.Tensor, theirs: torch.Tensor) -> bool:
        return torch.allclose(ours, theirs, atol=1e-5)

    def gather(values: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
        flat = where.view(1, 1, -1).expand(1, values.shape[1], -1)
        return values.gather(2, flat).view(1, values.shape[1], *where.shape[1:])

    def pool_in_torch() -> torch.Tensor:
        grown = rois.clone()
        grown[:, 3:6] += 0.4
        grown[:, 1] += 0.2
        turned = torch.cat([grown[:, :6], grown[:, 6:].cos(), grown[:, 6:].sin()], dim=1)
        slots, empty = _torch_points.first_in_boxes(points[None], turned[None], 10.0, 512)
        return torch.cat([points, rows], dim=1)[slots[0]] * ~empty[0][:, None, None]

    return [
        compare(
            "interpolate 256 channels, 4096 -> 16384",
            lambda: ops.three_interpolate(coarse, index, weight),
            {"torch gather": lambda: (gather(coarse, index) * weight[:, None]).sum(dim=-1)},
            repeats,
            close,
        ),
        compare(
            "group 256 channels, 1024 x 32 of 4096",
            lambda: ops.group_points(coarse, balls),
            {"torch gather": lambda: gather(coarse, balls)},
            repeats,
            close,
        ),
        compare(
            "RoI pooling, 100 RoIs x 512 of 16384, 133 channels",
            lambda: ops.roi_pool(points, rows, rois, 0.2, 512)[0],
            {"torch": pool_in_torch},
            repeats,
            close,
        ),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1, help="threads for torch and for our kernels (default 1)")
    parser.add_argument("--repeats", type=int, default=11)
    parser.add_argument("--out", help="also write the table to this Markdown file")
    parser.add_argument("--json", help="write the figures to this file")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    rows = []
    for bench in (bench_sampling, bench_neighbours, bench_boxes, bench_features):
        rows += bench(arguments.repeats)
    print(format_table(rows))
    save(arguments.json, [measure_of(row) for row in rows])
    if arguments.out:
        write_table(rows, arguments.out)


if __name__ == "__main__":
    main()
