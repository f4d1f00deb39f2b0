"""From a training run to embedded weights: held-out figures go into the card, files into the package.

    python -m pipeline.embedding completion RUN NAME --data HELD_OUT
    python -m pipeline.embedding detection RUN NAME --data HELD_OUT --cloud L
    python -m pipeline.embedding segmentation RUN NAME --data HELD_OUT

HELD_OUT is a synthetic data set made with another seed than the training set (run_pipeline --stage synth). With --again
RUN is another training of what NAME was trained by: its figures are put beside those on NAME's card, and nothing else
changes. That is how far a training of your own may be from the embedded weights.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from detection.kitti_format import KittiObject
from pipeline.benchmark.car_recall import car_recall
from pipeline.data import Dataset, open_dataset
from pipeline.data.projection import project_points
from pipeline.errors import UsageError
from pipeline.runner.atomic import write_text
from pipeline.simulation.lidar_rows import subsample_rows
from pipeline.weights import embedded_folder

ROOMS = {"completion": "completion", "detection": "detection", "segmentation": "pipeline/semantics"}
ROWS = (64, 32, 16, 8)
# Share of right cars that the score threshold in a card is chosen for.
PRECISION = 0.8
AT_THRESHOLD = "car, BEV IoU 0.7, hard"


@dataclass(frozen=True)
class HeldOut:
    """Frames to measure on, and for detectors the clouds they are given: a preset and its completion."""

    dataset: Dataset
    cloud: str = "L"
    completer: str = "classical"

    def figures(self, room: str, weights: Path) -> dict[str, Any]:
        """The figures of a card, with how many frames they are from."""
        if room == "completion":
            found = completion_figures(weights, self.dataset)
        elif room == "detection":
            found = detection_figures(weights, self)
        else:
            found = segmentation_figures(weights, self.dataset)
        return {"frames": len(self.dataset), **found}


def completion_figures(weights: Path, dataset: Dataset) -> dict[str, Any]:
    """Errors on dense truth by LiDAR rows: `completion.diagnostics.diagnose` (mm, %), mean over frames."""
    from completion.diagnostics import diagnose
    from completion.infer import load_completer
    from completion.types import DepthFrame

    completer = load_completer(str(weights), backend="auto")
    figures: dict[str, Any] = {}
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


def detection_figures(weights: Path, held_out: HeldOut) -> dict[str, Any]:
    """The score threshold of cars at 64 rows (see `operating_point`), and AP; recall and precision there at 16 too."""
    labels, found = detections(weights, held_out, 64)
    chosen = operating_point(labels, found)
    few = detections(weights, held_out, 16)
    return {
        AT_THRESHOLD: chosen,
        f"{AT_THRESHOLD}, 16 rows": recall_at(*few, chosen["threshold"]),
        "ap_r40": average_precision(labels, found),
        "ap_r40, 16 rows": average_precision(*few),
    }


Objects = list[list[KittiObject]]


def detections(weights: Path, held_out: HeldOut, rows: int) -> tuple[Objects, Objects]:
    """Labels and detections of all frames, their clouds made from so many LiDAR rows."""
    from completion.infer import load_completer
    from detection.infer import load_detector
    from detection.results import result_objects
    from detection.types import PointFrame
    from pipeline.benchmark.suite import DetectionRow, augmented_points

    detector = load_detector(str(weights))
    complete = load_completer(held_out.completer, backend="auto")
    labels, found = [], []
    for frame in held_out.dataset:
        points = augmented_points(frame, DetectionRow(str(weights), held_out.cloud, rows, 0), complete)
        camera = frame.calibration
        seen = PointFrame(points, camera.T_cam_velo, camera.P2, frame.image_size, frame.id)
        labels.append(frame.labels)
        found.append(result_objects(detector.detect(seen), seen))
    return labels, found


def average_precision(labels: Objects, found: Objects) -> dict[str, list[float | None]]:
    """AP R40 easy, moderate, hard by "CLASS METRIC IOU"; from above and in 3D."""
    from detection.evaluation.kitti_ap import evaluate

    return {
        f"{row['class']} {row['metric']} {row['iou']}": [row["easy"], row["moderate"], row["hard"]]
        for row in evaluate(labels, found)["results"]
        if row["metric"] in ("bev", "3d")
    }


def operating_point(labels: Objects, found: Objects) -> dict[str, float]:
    """The lowest score from which on `PRECISION` of the reported cars or more are cars (BEV, IoU 0.7); recall there."""
    for threshold in np.arange(0.1, 0.96, 0.025):
        if not recall_at(labels, found, float(threshold))["precision"] < PRECISION:
            break
    return recall_at(labels, found, round(float(threshold), 3))


def recall_at(labels: Objects, found: Objects, threshold: float) -> dict[str, float]:
    """Recall of cars up to "hard" and precision (BEV, IoU 0.7) of detections from this score on."""
    report = car_recall(labels, found, iou=0.7, metric="bev", score_threshold=threshold)
    return {"threshold": threshold, "recall": report.by_level["hard"].share, "precision": report.precision}


def segmentation_figures(weights: Path, dataset: Dataset) -> dict[str, Any]:
    """Share of pixels with the right class, and IoU of vehicles (car, truck, bus), over all frames."""
    from pipeline.semantics.conventions import CLASSES, NONE
    from pipeline.semantics.network import load_segmenter

    segmenter = load_segmenter(weights)
    vehicles = [CLASSES.index(name) for name in ("car", "truck", "bus")]
    right = counted = both = either = 0
    for frame in dataset:
        found, known = segmenter.segment(frame.image), frame.semantics != NONE
        right += int((found == frame.semantics)[known].sum())
        counted += int(known.sum())
        ours, theirs = np.isin(found, vehicles) & known, np.isin(frame.semantics, vehicles)
        both, either = both + int((ours & theirs).sum()), either + int((ours | theirs).sum())
    return {"pixel_accuracy": round(right / max(counted, 1), 4), "vehicle_iou": round(both / max(either, 1), 4)}


def embed(room: str, run: Path, name: str, held_out: HeldOut) -> Path:
    """Copies the run's weights and its card with the figures into the package. Raises UsageError without weights."""
    source = weights_of(room, run)
    card = json.loads(source.with_suffix(".json").read_text(encoding="utf-8"))
    card |= {"name": name, **measured(room, source, held_out)}
    target = embedded_folder(ROOMS[room]) / f"{name}.safetensors"
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    write_card(target.with_suffix(".json"), card)
    return target


def measured(room: str, weights: Path, held_out: HeldOut) -> dict[str, Any]:
    """The entries of a card that come from the held-out frames."""
    figures = held_out.figures(room, weights)
    if room != "detection":
        return {"held_out": figures}
    return {"held_out": figures, "cloud": held_out.cloud, "score_threshold": figures[AT_THRESHOLD]["threshold"]}


def note_again(room: str, run: Path, name: str, held_out: HeldOut) -> Path:
    """Puts the figures of another training beside those of the embedded NAME, both on the same frames.

    Raises UsageError when there is no such name, or the run has no weights.
    """
    embedded = embedded_folder(ROOMS[room]) / f"{name}.safetensors"
    if not embedded.is_file():
        raise UsageError(f"{embedded}: no embedded weights of this name; embed a first training without --again")
    source, path = weights_of(room, run), embedded.with_suffix(".json")
    card = json.loads(path.read_text(encoding="utf-8"))
    other = json.loads(source.with_suffix(".json").read_text(encoding="utf-8"))
    if card.get("held_out", {}).get("frames") != len(held_out.dataset):
        card |= {**measured(room, embedded, held_out), "trained_again": []}
    seed = other["seed"] if "seed" in other else other["training"].get("settings", other["training"])["seed"]
    repeat = {"seed": seed, "sha256": other["sha256"], "held_out": held_out.figures(room, source)}
    others = [each for each in card.get("trained_again", []) if each["sha256"] != repeat["sha256"]]
    card["trained_again"] = [*others, repeat]
    write_card(path, card)
    return path


def weights_of(room: str, run: Path) -> Path:
    """The weights of a training run. Raises UsageError when it has none."""
    folder = run / "weights" / room
    for name in ("best", "model", "last"):
        if (folder / f"{name}.safetensors").is_file():
            return folder / f"{name}.safetensors"
    raise UsageError(f"{folder}: expected best, model or last .safetensors of a training run, found none")


def write_card(path: Path, card: dict[str, Any]) -> None:
    """Write a card without the places of this machine."""
    write_text(path, json.dumps(without_places(card), indent=1, sort_keys=True) + "\n")


def without_places(value: Any) -> Any:
    """The card with folders of the machine it was made on cut down to their last name."""
    if isinstance(value, dict):
        return {key: without_places(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [without_places(inner) for inner in value]
    return Path(value).name if isinstance(value, str) and Path(value).is_absolute() else value


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; see the module's text."""
    parser = argparse.ArgumentParser(
        prog="python -m pipeline.embedding", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("room", choices=tuple(ROOMS))
    parser.add_argument("run", type=Path, help="folder of the training run")
    parser.add_argument("name", help="name of the embedded weights")
    parser.add_argument("--data", required=True, help="held-out synthetic data set in KITTI object layout")
    parser.add_argument("--frames", default="0:", help="frames of it (default: all)")
    parser.add_argument("--cloud", default="L", help="detection: preset of the clouds it was trained on")
    parser.add_argument("--completer", default="classical", help="detection: completion for augmented clouds")
    parser.add_argument("--again", action="store_true", help="note the figures of another training on the card of NAME")
    args = parser.parse_args(argv)
    dataset = open_dataset("kitti_object", args.data).select(args.frames)
    into = note_again if args.again else embed
    print(into(args.room, args.run, args.name, HeldOut(dataset, args.cloud, args.completer)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
