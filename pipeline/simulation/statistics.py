"""How like KITTI the synthetic world is: the same figures from real and from synthetic frames, as a table and plots.

Command:  python -m pipeline.simulation.statistics --real DIR --frames 200 --seed 0 --workers 2 --out docs/images
writes synthetic_statistics.md and synthetic_statistics.png to the folder given by --out. With --synthetic DIR the first
frames of a data set that `--stage synth` has written are described instead of simulating them again.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from detection.kitti_format import KittiObject, boxes_of
from pipeline.geometry.calibration import Calibration
from pipeline.geometry.in_view import in_view
from pipeline.geometry.project import project_points
from pipeline.geometry.rings import split_rings

DEPTH_EDGES = np.array([0, 5, 10, 15, 20, 30, 40, 60, 80.0])


@dataclass(frozen=True)
class FrameStatistics:
    """Figures of one frame.

    in_view, in_scan  LiDAR points in the image and in the whole scan; sparse_share: share of pixels with a value
    depth_shares      share of the sparse map's values per DEPTH_EDGES bin
    ring_returns      (64,) share of a ring's pulses in the camera's view that came back
    cars              rows (depth, points in box, occluded, truncated, h, w, l, box height in pixels) of cars
    other             label counts of all other types
    intensity         quantiles 10, 50, 90 % of the intensity of points in view
    brightness        mean, standard deviation (0..255) and share of saturated pixels of the image
    row_shares        points kept by 32, 16 and 8 rows of the scan, in percent above an even share of them
    edge_contrast, plain_contrast  median grey difference over 4 px across and away from depth edges
    """

    in_view: int
    in_scan: int
    sparse_share: float
    depth_shares: NDArray[np.float64]
    ring_returns: NDArray[np.float64]
    cars: NDArray[np.float64]
    other: dict[str, int]
    intensity: NDArray[np.float64]
    brightness: tuple[float, float, float]
    row_shares: tuple[float, float, float]
    edge_contrast: float
    plain_contrast: float


def describe(
    points: NDArray[np.float32], calibration: Calibration, labels: list[KittiObject], image: NDArray[np.uint8]
) -> FrameStatistics:
    """The figures of one frame from its scan (N, 4), calibration, labels and image (H, W, 3)."""
    size = (image.shape[0], image.shape[1])
    camera = calibration.velo_to_cam(points)
    pixels, depth = calibration.cam_to_image(camera)
    seen = in_view(points, calibration, size)
    sparse = project_points(points, calibration, size)
    values = sparse[sparse > 0]
    grey = image.astype(np.float32).mean(axis=2)
    edge, plain = _contrast(points, pixels, depth, seen, grey)
    ring = split_rings(points)
    half, quarter, eighth = (100 * (step * float((ring % step == 0).mean()) - 1) for step in (2, 4, 8))
    return FrameStatistics(
        in_view=int(seen.sum()),
        in_scan=len(points),
        sparse_share=float((sparse > 0).mean()),
        depth_shares=np.histogram(values, DEPTH_EDGES)[0] / max(len(values), 1),
        ring_returns=_ring_returns(points, ring),
        cars=_cars(camera, labels),
        other=_count(item.type for item in labels),
        intensity=np.quantile(points[seen, 3], [0.1, 0.5, 0.9]),
        brightness=(float(grey.mean()), float(grey.std()), float((grey > 250).mean())),
        row_shares=(half, quarter, eighth),
        edge_contrast=edge,
        plain_contrast=plain,
    )


def _count(types: Iterable[str]) -> dict[str, int]:
    result: dict[str, int] = {}
    for name in types:
        result[name] = result.get(name, 0) + 1
    return result


def points_in_box(camera: NDArray[np.float64], item: KittiObject, margin: float = 0.0) -> NDArray[np.bool_]:
    """(N,) True for rectified camera points (N, 3) inside a labelled box grown by `margin` metres on every side."""
    x, y, z, h, w, l, ry = boxes_of([item]).values[0]
    dx, dz = camera[:, 0] - x, camera[:, 2] - z
    along, across = dx * np.cos(ry) - dz * np.sin(ry), dx * np.sin(ry) + dz * np.cos(ry)
    up = y - camera[:, 1]
    inside = (np.abs(along) <= l / 2 + margin) & (np.abs(across) <= w / 2 + margin)
    return np.asarray(inside & (up >= -margin) & (up <= h + margin))


def _cars(camera: NDArray[np.float64], labels: list[KittiObject]) -> NDArray[np.float64]:
    rows = [
        (*[c.location[2], points_in_box(camera, c).sum(), c.occluded, c.truncated], *c.size, c.height_2d)
        for c in labels
        if c.type == "Car"
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 8)


def _ring_returns(points: NDArray[np.float32], ring: NDArray[np.int64]) -> NDArray[np.float64]:
    """Points of each ring within 38 degrees of forward as a share of the pulses fired there."""
    forward = np.abs(np.degrees(np.arctan2(points[:, 1], points[:, 0]))) < 38
    counts = np.bincount(ring[forward], minlength=64)[:64]
    return np.asarray(counts / (76 / 0.17))


def _contrast(
    points: NDArray[np.float32], pixels: NDArray[np.float64], depth: NDArray[np.float64], seen: NDArray[np.bool_],
    grey: NDArray[np.float32],
) -> tuple[float, float]:  # fmt: skip
    """Median grey difference over 4 px between neighbours of a scan line, across depth jumps and elsewhere."""
    both = seen[:-1] & seen[1:] & (np.abs(np.diff(pixels[:, 0])) < 8) & (np.abs(np.diff(pixels[:, 1])) < 3)
    jump = np.abs(np.diff(depth)) > np.maximum(2.0, 0.1 * np.minimum(depth[:-1], depth[1:]))
    middle = np.rint((pixels[:-1] + pixels[1:]) / 2).astype(int)
    result = []
    for chosen in (both & jump, both & ~jump):
        u, v = middle[chosen].T
        if not len(u):
            result.append(float("nan"))
            continue
        v = v.clip(0, grey.shape[0] - 1)
        left, right = grey[v, (u - 2).clip(0, grey.shape[1] - 1)], grey[v, (u + 2).clip(0, grey.shape[1] - 1)]
        result.append(float(np.median(np.abs(left - right))))
    return result[0], result[1]


def describe_folder(root: Path, count: int | None = None) -> list[FrameStatistics]:
    """Figures of the (first `count`) frames of a KITTI object folder, which has scans, images, calibration, labels."""
    from pipeline.data import open_dataset

    frames = open_dataset("kitti_object", root).select(slice(0, count))
    return [describe(f.points, f.calibration, f.labels, f.image) for f in frames]


def _describe_synthetic(seed: int, index: int) -> FrameStatistics:
    from pipeline.simulation.synth import SynthSettings, simulate_frame

    frame = simulate_frame(SynthSettings(frames=index + 1, seed=seed), index)
    return describe(frame.points, frame.calibration, frame.labels, frame.image)


def describe_synthetic(frames: int, seed: int, workers: int) -> list[FrameStatistics]:
    """Figures of the first frames of the data set with this seed."""
    work = partial(_describe_synthetic, seed)
    if workers <= 1:
        return [work(index) for index in range(frames)]
    from auglidar_base.children import process_pool

    with process_pool(workers) as pool:
        return list(pool.map(work, range(frames), chunksize=4))


def summary(frames: list[FrameStatistics]) -> dict[str, str]:
    """Named figures of a set of frames, as text for the table."""
    cars = np.concatenate([f.cars for f in frames])
    clear = cars[(cars[:, 2] == 0) & (cars[:, 3] < 0.1)] if len(cars) else cars

    def spread(values: Iterable[float], digits: int = 0) -> str:
        low, middle, high = np.quantile(np.array(list(values), dtype=float), [0.1, 0.5, 0.9])
        return f"{middle:.{digits}f} ({low:.{digits}f} - {high:.{digits}f})"

    rows = {
        "frames": str(len(frames)),
        "LiDAR points in view, median (10 - 90 %)": spread(f.in_view for f in frames),
        "LiDAR points in the scan": spread(f.in_scan for f in frames),
        "share of sparse pixels, %": spread((100 * f.sparse_share for f in frames), 2),
        "intensity in view: 10 %": spread((f.intensity[0] for f in frames), 2),
        "intensity in view: 50 %": spread((f.intensity[1] for f in frames), 2),
        "intensity in view: 90 %": spread((f.intensity[2] for f in frames), 2),
        "image mean": spread(f.brightness[0] for f in frames),
        "image standard deviation": spread(f.brightness[1] for f in frames),
        "saturated pixels, %": spread((100 * f.brightness[2] for f in frames), 1),
        "grey step across depth edges": spread((f.edge_contrast for f in frames), 1),
        "grey step elsewhere": spread((f.plain_contrast for f in frames), 1),
        **{
            f"points of {rows} rows, % above 1/{step} (worst)": f"{_mean_and_worst([f.row_shares[k] for f in frames])}"
            for k, (rows, step) in enumerate(((32, 2), (16, 4), (8, 8)))
        },
        "cars per frame (mean)": f"{len(cars) / len(frames):.1f}",
    }
    for low, high in ((0, 10), (10, 20), (20, 30), (30, 45), (45, 80)):
        near = clear[(clear[:, 0] >= low) & (clear[:, 0] < high)]
        rows[f"points per clear car, {low}-{high} m (median; cars)"] = (
            f"{np.median(near[:, 1]) if len(near) else 0:.0f}; {len(near)}"
        )
    middle = clear[(clear[:, 0] > 5) & (clear[:, 0] < 45)]
    rows["points x (distance / 10 m)^2 per clear car, 5-45 m"] = spread(middle[:, 1] * (middle[:, 0] / 10) ** 2)
    for level in range(4):
        rows[f"cars with occlusion {level}, %"] = f"{100 * float((cars[:, 2] == level).mean()):.0f}"
    rows["cars truncated over 0.1, %"] = f"{100 * float((cars[:, 3] > 0.1).mean()):.0f}"
    for name, column in (("height", 4), ("width", 5), ("length", 6)):
        rows[f"car {name}, mean +- sd, m"] = f"{cars[:, column].mean():.2f} +- {cars[:, column].std():.2f}"
    for low, high, share in zip(DEPTH_EDGES[:-1], DEPTH_EDGES[1:], np.mean([f.depth_shares for f in frames], axis=0)):
        rows[f"sparse depths in {low:.0f}-{high:.0f} m, %"] = f"{100 * share:.1f}"
    names = ("Van", "Truck", "Pedestrian", "Cyclist", "Misc", "DontCare")
    rows["Van, Truck, Pedestrian, Cyclist, Misc, DontCare per frame"] = ", ".join(
        f"{sum(f.other.get(name, 0) for f in frames) / len(frames):.1f}" for name in names
    )
    return rows


def _mean_and_worst(values: list[float]) -> str:
    """The mean, and the value farthest from 0, as text."""
    return f"{np.mean(values):+.1f} ({max(values, key=abs):+.1f})"


def table(real: list[FrameStatistics], synthetic: list[FrameStatistics]) -> str:
    """A Markdown table of both sets side by side."""
    left, right = summary(real), summary(synthetic)
    lines = ["| figure | KITTI | synthetic |", "|---|---|---|"]
    return "\n".join(lines + [f"| {name} | {left[name]} | {right[name]} |" for name in left]) + "\n"


def plot(real: list[FrameStatistics], synthetic: list[FrameStatistics], path: Path) -> None:
    """Four plots: points per car over distance, depth histogram, returns per ring, points in view."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7.5), layout="constrained")
    axes = figure.subplots(2, 2)
    bins = np.arange(len(DEPTH_EDGES) - 1)
    for frames, colour, name, offset in (
        (synthetic, "tab:orange", "synthetic", 0.2),
        (real, "tab:blue", "KITTI", -0.2),
    ):
        cars = np.concatenate([f.cars for f in frames])
        axes[0, 0].scatter(cars[:, 0], np.maximum(cars[:, 1], 0.7), s=9, alpha=0.6, color=colour, label=name)
        axes[0, 1].bar(
            bins + offset, 100 * np.mean([f.depth_shares for f in frames], axis=0), 0.4, color=colour, label=name
        )
        axes[1, 0].plot(100 * np.mean([f.ring_returns for f in frames], axis=0), color=colour, label=name)
        axes[1, 1].hist([f.in_view / 1000 for f in frames], bins=20, density=True, alpha=0.6, color=colour, label=name)
    axes[0, 0].set(yscale="log", xlabel="distance of the car, m", ylabel="LiDAR points in its box")
    labels = [f"{low:.0f}-{high:.0f}" for low, high in pairwise(DEPTH_EDGES)]
    axes[0, 1].set(xlabel="depth, m", ylabel="% of the sparse map")
    axes[0, 1].set_xticks(bins, labels)
    axes[1, 0].set(xlabel="ring, 0 = top", ylabel="% of pulses returned, +-38 degrees")
    axes[1, 1].set(xlabel="thousand points in view", ylabel="density of frames")
    for axis in axes.ravel():
        axis.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def main(arguments: list[str] | None = None) -> int:
    """Command line; see the module's text."""
    parser = argparse.ArgumentParser(prog="python -m pipeline.simulation.statistics", description=__doc__)
    parser.add_argument("--real", type=Path, required=True, help="KITTI object folder with training/")
    parser.add_argument("--synthetic", type=Path, default=None, help="KITTI object folder written by --stage synth")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    options = parser.parse_args(arguments)
    real = describe_folder(options.real)
    if options.synthetic is not None:
        synthetic = describe_folder(options.synthetic, options.frames)
    else:
        synthetic = describe_synthetic(options.frames, options.seed, options.workers)
    text = table(real, synthetic)
    plot(real, synthetic, options.out / "synthetic_statistics.png")
    (options.out / "synthetic_statistics.md").write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
