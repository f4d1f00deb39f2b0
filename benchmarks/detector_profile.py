"""Where the time of one detector forward goes: `python -m benchmarks.detector_profile [--preset NAME] [--threads 1]`.

One KITTI-like frame with untrained weights; every operation of `detection.ops` is timed by name beside torch's own.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile, record_function

from benchmarks.ops import lidar_cloud
from benchmarks.record import Measure, save
from detection.models import compact, openpcdet_pointrcnn, pointnet2, pointrcnn, proposals
from detection.models.batch import PointBatch
from detection.models.presets import PRESETS

# The modules that call each of our operations.
CALLERS: dict[str, tuple[Any, ...]] = {
    "furthest_point_sample": (pointnet2,),
    "ball_query": (pointnet2,),
    "three_nn": (pointnet2,),
    "nms_axis_aligned": (proposals,),
    "nms_rotated": (proposals,),
    "roi_pool": (pointrcnn, compact, openpcdet_pointrcnn),
}
MATRIX_PRODUCTS = ("aten::addmm", "aten::mm", "aten::bmm", "aten::mkldnn_linear", "mkl::linear")


def named(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function under a name in the profile."""

    def call(*args: Any, **kwargs: Any) -> Any:
        with record_function(f"ours::{name}"):
            return function(*args, **kwargs)

    return call


@contextmanager
def operations_by_name() -> Iterator[None]:
    """Our operations appear in the profile while this holds."""
    with ExitStack() as stack:
        for name, modules in CALLERS.items():
            for module in modules:
                stack.enter_context(patch.object(module, name, named(name, getattr(module, name))))
        yield


def frame(points: int, channels: int, seed: int = 0) -> PointBatch:
    """A batch of one cloud as a 64-ring scanner sees it, with zero features; the full cloud has 20,000 points."""
    rng = np.random.default_rng(seed)
    cloud = torch.from_numpy(rng.permutation(lidar_cloud(max(points, 20000), seed)))
    rows = torch.cat([cloud, torch.zeros(len(cloud), channels)], dim=1)
    return PointBatch(rows[None, :points].contiguous(), [rows[:20000]], [], [])


def batch_times(model: Any, one: PointBatch, sizes: tuple[int, ...], repeats: int) -> dict[int, float]:
    """Milliseconds per frame when so many frames go through together."""
    found = {}
    for size in sizes:
        batch = PointBatch(one.points.repeat(size, 1, 1), one.clouds * size, [], [])
        times = []
        with torch.inference_mode():
            for _ in range(repeats + 1):
                start = time.perf_counter()
                model.raw_detections(batch)
                times.append(time.perf_counter() - start)
        found[size] = float(np.median(times[1:])) * 1e3 / size
    return found


def profile_forward(preset_name: str, repeats: int) -> tuple[list[tuple[str, float, int]], float, dict[int, float]]:
    """Rows (operation, milliseconds and calls per forward), slowest first; the wall time in milliseconds; and that of
    one frame in batches of 1, 2 and 4."""
    preset = PRESETS[preset_name]()
    torch.manual_seed(0)
    model: Any = preset.build().eval()
    batch = frame(preset.inputs.points, len(preset.inputs.features))
    with torch.inference_mode(), operations_by_name():
        model.raw_detections(batch)
        times = []
        for _ in range(repeats):
            start = time.perf_counter()
            model.raw_detections(batch)
            times.append(time.perf_counter() - start)
        with profile(activities=[ProfilerActivity.CPU]) as recorded:
            for _ in range(repeats):
                model.raw_detections(batch)
    rows: dict[str, tuple[float, int]] = {}
    for event in recorded.key_averages():
        ours = event.key.startswith("ours::")
        key = "matrix products" if event.key in MATRIX_PRODUCTS else event.key
        microseconds = event.cpu_time_total if ours else event.self_cpu_time_total
        total, calls = rows.get(key, (0.0, 0))
        rows[key] = (total + microseconds / 1e3 / repeats, calls + event.count // repeats)
    ordered = sorted(((name, *values) for name, values in rows.items()), key=lambda row: -row[1])
    return ordered, float(np.median(times)) * 1e3, batch_times(model, batch, (1, 2, 4), repeats)


def main() -> int:
    """Print the table; exit code 1 when an operation of ours takes longer than the matrix products."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", choices=sorted(PRESETS), default="pointrcnn2")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, help="write the table to this Markdown file as well")
    parser.add_argument("--json", help="write the figures to this file")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    rows, wall, batches = profile_forward(options.preset, options.repeats)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    lines = [
        f"{options.preset}: {wall:.0f} ms per frame (median of {options.repeats}), {options.threads} threads, "
        f"peak memory of the process {peak:.0f} MB, torch {torch.__version__}",
        "",
        "| operation | ms per frame | calls |",
        "| --- | ---: | ---: |",
        *(f"| {name} | {milliseconds:.1f} | {calls} |" for name, milliseconds, calls in rows[:16]),
        "",
        "Batches: " + ", ".join(f"{size} frames {time:.1f} ms each" for size, time in batches.items()),
    ]
    print("\n".join(lines))
    if options.out is not None:
        options.out.write_text("\n".join(lines) + "\n")
    products = next(milliseconds for name, milliseconds, _ in rows if name == "matrix products")
    slowest = max(milliseconds for name, milliseconds, _ in rows if name.startswith("ours::"))
    title = f"{options.preset}: slowest operation of ours, beside the matrix products"
    forward = Measure(f"{options.preset}: forward, {options.threads} threads", wall / 1e3)
    save(options.json, [Measure(title, slowest / 1e3, "s", {"matrix products": products / 1e3}), forward])
    slow = [name for name, milliseconds, _ in rows if name.startswith("ours::") and milliseconds > products]
    print(f"\nOperations of ours slower than the matrix products ({products:.0f} ms): {', '.join(slow) or 'none'}")
    return 1 if slow else 0


if __name__ == "__main__":
    sys.exit(main())
