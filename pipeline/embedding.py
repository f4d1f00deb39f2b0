"""From a training run to embedded weights: held-out figures go into the card, files into the package.

    python -m pipeline.embedding completion RUN NAME --data HELD_OUT
    python -m pipeline.embedding detection RUN NAME --data HELD_OUT --cloud L

HELD_OUT is a synthetic data set made with another seed than the training set (run_pipeline --stage synth).
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from detection.kitti_format import KittiObject
from pipeline.benchmark.car_recall import car_recall
from pipeline.data import Dataset, open_dataset
from pipeline.data.projection import project_points
from pipeline.errors import UsageError
from pipeline.simulation.lidar_rows import subsample_rows
from pipeline.weights import embedded_folder

ROWS = (64, 32, 16, 8)
# Share of right cars that the score threshold in a card is chosen for.
PRECISION = 0.8


def completion_figures(weights: Path, dataset: Dataset) -> dict[str, Any]:
    """Errors on dense truth by LiDAR rows: `completion.diagnostics.diagnose` (mm, %), mean over frames."""
    from completion.diagnostics import diagnose
    from completion.infer import load_completer
    from completion.types import DepthFrame

    completer = load_completer(str(weights))
    figures: dict[str, Any] = {"frames": len(dataset)}
    for rows in ROWS:
        frames = (
            DepthFrame(
                frame.image,
                project_points(subsample_rows(frame.points, 64 // rows), frame.calibration, frame.image_size),
                frame.target_depth,
            )
            for frame in dataset
        )
        figures[f"{rows} rows"] = {key: round(value, 4) for key, value in diagnose(completer, frames).items()}
    return figures


def detection_figures(weights: Path, dataset: Dataset, cloud: str, completer: str) -> dict[str, Any]:
    """The score threshold of cars (see `operating_point`), recall and precision there, and AP."""
    from completion.infer import load_completer
    from detection.evaluation.kitti_ap import evaluate
    from detection.infer import load_detector
    from detection.results import result_objects
    from detection.types import PointFrame
    from pipeline.benchmark.suite import DetectionRow, augmented_points

    detector = load_detector(str(weights))
    complete = load_completer(completer)
    labels, found = [], []
    for frame in dataset:
        points = augmented_points(frame, DetectionRow(str(weights), cloud, 64, 0), complete)
        camera = frame.calibration
        seen = PointFrame(points, camera.T_cam_velo, camera.P2, frame.image_size, frame.id)
        labels.append(frame.labels)
        found.append(result_objects(detector.detect(seen), seen))
    chosen = operating_point(labels, found)
    rows = evaluate(labels, found)["results"]
    ap = {
        f"{row['class']} {row['metric']} {row['iou']}": [row["easy"], row["moderate"], row["hard"]]
        for row in rows
        if row["metric"] in ("bev", "3d")
    }
    return {"frames": len(dataset), "car, BEV IoU 0.7, hard": chosen, "ap_r40": ap}


def operating_point(labels: list[list[KittiObject]], found: list[list[KittiObject]]) -> dict[str, float]:
    """The lowest score from which on `PRECISION` of the reported cars or more are cars (BEV, IoU 0.7); recall there."""
    for threshold in np.arange(0.1, 0.96, 0.025):
        report = car_recall(labels, found, iou=0.7, metric="bev", score_threshold=float(threshold))
        if not report.precision < PRECISION:
            break
    return {
        "threshold": round(float(threshold), 3),
        "recall": report.by_level["hard"].share,
        "precision": report.precision,
    }


def embed(room: str, run: Path, name: str, dataset: Dataset, cloud: str, completer: str) -> Path:
    """Copies the run's weights and its card with the figures into the package. Raises UsageError without weights."""
    folder = run / "weights" / room
    candidates = [folder / "best.safetensors", folder / "model.safetensors", folder / "last.safetensors"]
    source = next((path for path in candidates if path.is_file()), None)
    if source is None:
        raise UsageError(f"{folder}: expected best, model or last .safetensors of a training run, found none")
    card = json.loads(source.with_suffix(".json").read_text(encoding="utf-8"))
    card["name"] = name
    if room == "completion":
        card["training"]["held_out"] = completion_figures(source, dataset)
    else:
        figures = detection_figures(source, dataset, cloud, completer)
        card |= {"cloud": cloud, "held_out": figures, "score_threshold": figures["car, BEV IoU 0.7, hard"]["threshold"]}
    card = without_places(card)
    target = embedded_folder(room) / f"{name}.safetensors"
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    target.with_suffix(".json").write_text(json.dumps(card, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    return target


def without_places(value: Any) -> Any:
    """The card with folders of the machine it was made on cut down to their last name."""
    if isinstance(value, dict):
        return {key: without_places(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [without_places(inner) for inner in value]
    return Path(value).name if isinstance(value, str) and Path(value).is_absolute() else value


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; see the module's text."""
    parser = argparse.ArgumentParser(prog="python -m pipeline.embedding", description=__doc__)
    parser.add_argument("room", choices=("completion", "detection"))
    parser.add_argument("run", type=Path, help="folder of the training run")
    parser.add_argument("name", help="name of the embedded weights")
    parser.add_argument("--data", required=True, help="held-out synthetic data set in KITTI object layout")
    parser.add_argument("--frames", default="0:", help="frames of it (default: all)")
    parser.add_argument("--cloud", default="L", help="detection: preset of the clouds it was trained on")
    parser.add_argument("--completer", default="classical", help="detection: completion for augmented clouds")
    args = parser.parse_args(argv)
    dataset = open_dataset("kitti_object", args.data).select(args.frames)
    print(embed(args.room, args.run, args.name, dataset, args.cloud, args.completer))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
