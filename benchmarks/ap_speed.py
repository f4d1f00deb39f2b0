"""Speed and memory of the KITTI AP evaluator on a synthetic set as large as KITTI val.

    python -m benchmarks.ap_speed                 # 3769 frames, about 24 thousand detections
    python -m benchmarks.ap_speed --twin 100      # also the plain Python twin on the first 100 frames

Prints CPU seconds of one core (other load on the machine does not count) for reading and for evaluating (2D, AOS, BEV,
3D; strict and loose; three classes and levels), in a fresh process with numba's cache and again, and its peak memory.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.record import Measure, save

MEASURE = """
import resource, sys, time
start = time.process_time()
from detection.evaluation.kitti_ap import evaluate, prepare
imported = time.process_time()
evaluate(sys.argv[1], sys.argv[2])
first = time.process_time()
evaluation = prepare(sys.argv[1], sys.argv[2])
read = time.process_time()
report = evaluation.report()
done = time.process_time()
print(imported - start, first - imported, read - first, done - read,
      resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, report["protocol"]["detections"])
"""
CLASSES = {"Car": (1.5, 1.6, 3.9), "Pedestrian": (1.75, 0.6, 0.8), "Cyclist": (1.7, 0.6, 1.8), "Van": (2, 1.9, 5)}
DONTCARE = "DontCare -1 -1 -10 {:.2f} {:.2f} {:.2f} {:.2f} -1 -1 -1 -1000 -1000 -1000 -10"


def line(cls: str, values: np.ndarray, rng: np.random.Generator, score: float | None) -> str:
    """One KITTI line of a box (x, y, z, h, w, l, ry) with a plausible image box."""
    x, y, z, h, w, l, ry = values
    u, v, width, height = 720 * x / z + 610, 720 * (y - h) / z + 173, 720 * l / z, 720 * h / z
    head = f"{cls} -1 -1" if score is not None else f"{cls} {rng.choice([0, 0, 0.2, 0.4]):.2f} {rng.integers(0, 4)}"
    numbers = [ry - np.arctan2(x, z), u - width / 2, v, u + width / 2, v + height, h, w, l, x, y, z, ry]
    text = f"{head} " + " ".join(f"{value:.2f}" if score is None else f"{value:.4f}" for value in numbers)
    return text if score is None else f"{text} {score:.6f}"


def write_set(root: Path, frames: int, seed: int = 0) -> tuple[Path, Path]:
    """Labels (4.7 a frame) and detections (6.4 a frame) in two folders; returns both."""
    labels, detections = root / "label_2", root / "detections"
    labels.mkdir()
    detections.mkdir()
    for frame in range(frames):
        rng = np.random.default_rng((seed, frame))
        truth, found = [], []
        for _ in range(rng.poisson(3.7)):
            cls = str(rng.choice(list(CLASSES), p=[0.65, 0.17, 0.08, 0.1]))
            box = np.array([rng.uniform(-12, 12), 1.6, rng.uniform(6, 65), *CLASSES[cls], rng.uniform(-3.1, 3.1)])
            truth.append(line(cls, box, rng, None))
            for _ in range(rng.choice([0, 1, 1, 2])):
                near = box + rng.standard_normal(7) * [0.1, 0.05, 0.15, 0.05, 0.05, 0.1, 0.08]
                found.append(line("Car" if cls == "Van" else cls, near, rng, rng.beta(4, 2)))
        for _ in range(rng.poisson(2.7)):
            cls = str(rng.choice(list(CLASSES)[:3]))
            box = np.array([rng.uniform(-12, 12), 1.6, rng.uniform(6, 65), *CLASSES[cls], rng.uniform(-3.1, 3.1)])
            found.append(line(cls, box, rng, rng.beta(2, 4)))
        for _ in range(rng.poisson(1.0)):
            left, top = rng.uniform(0, 1100), rng.uniform(150, 200)
            truth.append(DONTCARE.format(left, top, left + 80, top + 40))
        (labels / f"{frame:06d}.txt").write_text("".join(f"{text}\n" for text in truth))
        (detections / f"{frame:06d}.txt").write_text("".join(f"{text}\n" for text in found))
    return labels, detections


def time_twin(labels: Path, detections: Path, frames: int) -> Measure:
    """The plain Python twin and ours on the first frames (3D and 2D, Car, moderate, IoU 0.7)."""
    from detection.evaluation.kitti_ap import evaluate
    from detection.kitti_format import parse_lines
    from tests.reference.kitti_ap_twin import average_precision

    names = [f"{frame:06d}" for frame in range(frames)]
    sides = [[parse_lines((folder / f"{name}.txt").read_text()) for name in names] for folder in (labels, detections)]
    evaluate(*sides, classes=["Car"], metrics=["2d", "3d"], iou_set="strict")  # loads the compiled kernels
    start = time.process_time()
    twin = [average_precision(*sides, "Car", metric, 0.7, 1) for metric in ("2d", "3d")]
    middle = time.process_time()
    rows = evaluate(*sides, classes=["Car"], metrics=["2d", "3d"], iou_set="strict")["results"]
    end = time.process_time()
    print(f"twin on {frames} frames  {middle - start:8.2f} s  AP {twin[0]:.4f} {twin[1]:.4f} (2 values)")
    ours = f"AP {rows[0]['moderate']:.4f} {rows[1]['moderate']:.4f} (and easy, hard)"
    print(f"ours on {frames} frames  {end - middle:8.2f} s  {ours}")
    agree = all(abs(one - row["moderate"]) < 1e-6 for one, row in zip(twin, rows))
    title = f"{frames} frames, two values, beside the plain Python twin"
    return Measure(title, end - middle, "s", {"plain Python": middle - start}, agree)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=3769)
    parser.add_argument("--twin", type=int, default=0, metavar="N", help="also time the plain Python twin on N frames")
    parser.add_argument("--json", help="write the figures to this file")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        labels, detections = write_set(Path(folder), arguments.frames)
        one_core = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
        command = [sys.executable, "-c", MEASURE, str(labels), str(detections)]
        for _ in range(2):  # the first process compiles if need be, the second finds numba's cache
            output = subprocess.run(command, env=one_core, check=True, capture_output=True, text=True).stdout.split()
        imports, first, read, rest, memory, count = map(float, output)
        print(f"{arguments.frames} frames, {int(count)} detections, CPU seconds of one core")
        print(f"import             {imports:6.2f} s")
        print(f"first evaluation   {first:6.2f} s (numba's cache on disk)")
        print(f"second: read       {read:6.2f} s")
        print(f"second: evaluate   {rest:6.2f} s")
        print(f"peak memory        {memory:6.0f} MB")
        title = f"{arguments.frames} frames"
        measures = [
            Measure(f"{title}, first evaluation", imports + first),
            Measure(f"{title}, evaluation", read + rest),
            Measure(f"{title}, peak memory", memory, "MB"),
        ]
        if arguments.twin:
            measures.append(time_twin(labels, detections, arguments.twin))
        save(arguments.json, measures)


if __name__ == "__main__":
    main()
