"""How costs grow with points, frames, rows, image size and detections: `python -m benchmarks.scaling`.

Each curve is timed on one thread over sizes in a row, and its slope taken on the larger half: 1 is linear.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.ap_speed import write_set
from benchmarks.completion import fastest
from benchmarks.ops import lidar_cloud, street_boxes
from benchmarks.pointcloud import ours as four_steps
from benchmarks.pointcloud_frame import StreetFrame, kitti_calibration, street_frame
from benchmarks.record import Curve, save
from completion.infer import load_completer
from completion.types import CompletedDepth
from detection import ops
from detection.evaluation.kitti_ap import evaluate
from detection.infer import load_detector
from detection.inputs import ground_height
from detection.types import PointFrame

# A cost that grows faster than this is looked at: the text says why.
LIMIT = 1.15
REASONS = {
    "rotated NMS": "every box is compared with those kept before it, which grow with the boxes: at most quadratic",
    "three nearest": "linear in the points; queries and results leave the caches (half as much again per point)",
    "furthest points": "4096 of N; blocks that a new sample cannot change are skipped",
}


def curve(name: str, sizes: Sequence[int], make: Callable[[int], Callable[[], Any]], repeats: int) -> Curve:
    """Fastest of some runs for each size; `make(size)` prepares one."""
    return Curve(name, tuple(sizes), tuple(fastest(make(size), repeats) for size in sizes))


def point_curves(sizes: Sequence[int], repeats: int) -> list[Curve]:
    """Operations over the points of one cloud."""

    def sampling(count: int) -> Callable[[], Any]:
        points = torch.from_numpy(lidar_cloud(count))
        return lambda: ops.furthest_point_sample(points, min(4096, count))

    def balls(count: int) -> Callable[[], Any]:
        points = torch.from_numpy(lidar_cloud(count))
        centres = points[:: max(1, count // 4096)][:4096].contiguous()
        return lambda: ops.ball_query(points, centres, 0.5, 32)

    def nearest(count: int) -> Callable[[], Any]:
        points = torch.from_numpy(lidar_cloud(count))
        known = points[:: max(1, count // 4096)][:4096].contiguous()
        return lambda: ops.three_nn(points, known)

    def ground(count: int) -> Callable[[], Any]:
        cloud = lidar_cloud(count)
        return lambda: ground_height(cloud)

    kinds = {"furthest points": sampling, "ball query": balls, "three nearest": nearest, "ground height": ground}
    return [curve(f"{name}, points", sizes, make, repeats) for name, make in kinds.items()]


def detector_curve(sizes: Sequence[int], repeats: int) -> Curve:
    """The bundled LiDAR detector over the points of a scan."""
    detector = load_detector("small_lidar")
    calibration = kitti_calibration()

    def detect(count: int) -> Callable[[], Any]:
        camera = lidar_cloud(count)
        velo = camera @ calibration.T_velo_cam[:3, :3].T + calibration.T_velo_cam[:3, 3]
        points = np.column_stack([velo, np.zeros(count)]).astype(np.float32)
        frame = PointFrame(points, calibration.T_cam_velo, calibration.P2, (375, 1242), "scan")
        return lambda: detector.detect(frame)

    return curve("detection, points", sizes, detect, repeats)


def box_curves(sizes: Sequence[int], repeats: int) -> list[Curve]:
    """Suppression of detections, 100 kept and all kept."""

    def suppress(count: int) -> Callable[[], Any]:
        boxes, scores = street_boxes(count, 3), np.random.default_rng(4).normal(size=count)
        return lambda: ops.nms_rotated(boxes, scores, 0.7, 100)

    return [curve("rotated NMS, detections", sizes, suppress, repeats)]


def enlarged(frame: StreetFrame, factor: int) -> StreetFrame:
    """The frame with every `factor`-th pixel kept and the camera to match, or the whole of it for 1."""
    from dataclasses import replace

    completed = frame.completed
    maps = (completed.depth, completed.foreground, completed.background, completed.sigma)
    small = CompletedDepth(*(np.ascontiguousarray(part[::factor, ::factor]) for part in maps if part is not None))
    P2 = frame.calibration.P2.copy()
    P2[:2] /= factor
    calibration = replace(frame.calibration, P2=P2)
    return StreetFrame(small, frame.truth[::factor, ::factor], frame.points, calibration)


def image_curves(factors: Sequence[int], repeats: int) -> list[Curve]:
    """Completion and augmentation over the size of the image, and completion over LiDAR rows."""
    frame = street_frame()
    completer = load_completer("selection_small", backend="auto")
    sizes = [375 // factor * (1242 // factor) for factor in factors]
    shapes = dict(zip(sizes, factors))

    def complete(pixels: int) -> Callable[[], Any]:
        factor = shapes[pixels]
        sparse = np.where(np.random.default_rng(0).uniform(size=frame.truth.shape) < 0.04, frame.truth, 0)
        sparse = np.ascontiguousarray(sparse[: 375 // factor, : 1242 // factor], dtype=np.float32)
        image = np.full((*sparse.shape, 3), 90, np.uint8)
        return lambda: completer.complete(sparse, image)

    def augment(pixels: int) -> Callable[[], Any]:
        small = enlarged(frame, shapes[pixels])
        return lambda: four_steps(small, "nearest")

    def gather(rows: int) -> Callable[[], Any]:
        few = StreetFrame(frame.completed, frame.truth, frame.points[:: 64 // rows], frame.calibration)
        return lambda: four_steps(few, "nearest")

    return [
        curve("completion, pixels", sizes, complete, repeats),
        curve("four cloud steps, pixels", sizes, augment, repeats),
        curve("four cloud steps, LiDAR rows", (8, 16, 32, 64), gather, repeats),
    ]


def frame_curves(sizes: Sequence[int], repeats: int) -> list[Curve]:
    """AP over the frames of a set."""
    with tempfile.TemporaryDirectory() as folder:
        sets = {}
        for frames in sizes:
            root = Path(folder) / str(frames)
            root.mkdir()
            sets[frames] = write_set(root, frames)
        return [curve("AP, frames", sizes, lambda frames: lambda: evaluate(*sets[frames]), repeats)]


def table(curves: Sequence[Curve]) -> str:
    """Markdown: sizes, milliseconds, slope, and the reason where a slope is above `LIMIT`."""
    lines = ["| cost over | sizes | ms | slope | |", "|---|---|---|---:|---|"]
    for one in curves:
        sizes = ", ".join(f"{size:g}" for size in one.sizes)
        times = ", ".join(f"{1e3 * value:.3g}" for value in one.seconds)
        why = next((text for name, text in REASONS.items() if one.name.startswith(name)), "**why?**")
        lines.append(f"| {one.name} | {sizes} | {times} | {one.slope:.2f} | {why if one.slope > LIMIT else ''} |")
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small sizes: whether it runs, not how fast")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json")
    options = parser.parse_args()
    torch.set_num_threads(1)
    points = (1000, 2000) if options.quick else (10_000, 30_000, 100_000, 300_000, 500_000)
    boxes = (50, 100) if options.quick else (100, 300, 1000, 3000, 10_000)
    frames = (2, 4) if options.quick else (10, 30, 100, 300, 1000)
    curves = [*point_curves(points, options.repeats), detector_curve(points, options.repeats)]
    curves += box_curves(boxes, options.repeats)
    curves += image_curves((8, 4) if options.quick else (4, 3, 2, 1), options.repeats)
    curves += frame_curves(frames, options.repeats)
    print(table(curves))
    save(options.json, [], curves)


if __name__ == "__main__":
    main()
