"""`run_pipeline --stage bench`: accuracy on real frames without depth ground truth and masks."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from auglidar_base.atomic import write_text
from auglidar_base.errors import CheckpointError, SettingsError
from pipeline.base.errors import UsageError

if TYPE_CHECKING:
    from pipeline.data import Dataset

COLUMNS = ("mae", "rmse", "tmae", "trmse", "mixed", "mixed_all", "edge_tmae", "missing", "seconds")


EXAMPLES = """\
example:
  run_pipeline --stage bench --suite real --data KITTI --frames 0:11 \\
      --rows 32,16
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.epilog = EXAMPLES
    add = parser.add_argument
    add(
        "--suite",
        choices=("real", "edges"),
        default="real",
        help="real: held-out LiDAR rings, objects and masks on KITTI frames; edges: how low the error at depth edges "
        "can get there (--data, --frames, --rows, --out and --json alone count)",
    )
    add("--data", required=True, metavar="DIR", help="KITTI object folder (training/velodyne, image_2, calib, label_2)")
    add("--frames", metavar="FILE|a:b|ids", help="split file, positions, or ids separated by commas")
    add("--rows", default="32,16,8", metavar="N,N", help="LiDAR rows given to completion (default: 32,16,8)")
    add(
        "--completers",
        metavar="NAME,NAME",
        help="nearest, classical, bundled (all of them), names, files, module:Class (default: the first three)",
    )
    add(
        "--detectors",
        metavar="NAME,NAME",
        help="bundled (every bundled one), names, files, module:Class (default: bundled); '' for none",
    )
    add(
        "--masks",
        metavar="NAME,NAME",
        default="network,boxes",
        help="mask sources (default: network,boxes); '' for none",
    )
    add(
        "--threshold",
        type=float,
        metavar="S",
        help="lowest score that counts (default: each class' own, from the card)",
    )
    add("--out", metavar="DIR", help="also write real.json, real.md and camera.png (edges.json, edges.md) there")
    add("--json", action="store_true", help="print JSON instead of tables")


def run(args: argparse.Namespace) -> int:
    """Measures and prints; 0 when done."""
    from pipeline.benchmark.mask_points import mask_scores
    from pipeline.benchmark.suite import WITHOUT_WEIGHTS, completion_scores, detection_scores, row_numbers
    from pipeline.data import open_dataset
    from pipeline.semantics.sources import open_semantics

    dataset = open_dataset("kitti_object", args.data)
    if args.frames:
        dataset = dataset.select(args.frames)

    def progress(text: str) -> None:
        print(f"  {text}", file=sys.stderr)

    if args.suite == "edges":
        return _edges(dataset, args, progress)
    # Everything is opened before anything is measured: a wrong name should not cost an hour.
    try:
        names, rows = _completers(args.completers), row_numbers(args.rows)
        detectors = _detection_rows(args.detectors, args.threshold)
    except (SettingsError, CheckpointError) as error:
        raise UsageError(str(error)) from None
    masks = {name: open_semantics(name) for name in args.masks.split(",") if name}
    labelled = all(dataset[frame_id].has("labels") for frame_id in dataset.ids)
    if not labelled:
        progress("not every frame has labels: objects and masks are not measured")
    found: dict[str, Any] = {"frames": len(dataset), "completion": completion_scores(dataset, names, rows, progress)}
    if detectors and labelled:
        best = [name for name in names if name not in WITHOUT_WEIGHTS] or ["classical"]
        found["detection_depth"] = best[-1]
        progress(f"augmented clouds of the detectors are made from the depth of {best[-1]}")
        found["detection"] = detection_scores(dataset, detectors, best[-1], progress)
    if masks and labelled:
        found["masks"] = mask_scores(dataset, masks, progress)
    tables = _tables(found)
    _give(found, tables, args, "real")
    if args.out:
        _plot(Path(args.out), found["completion"])
    return 0


def _completers(chosen: str | None) -> list[str]:
    """The methods asked for. Raises CheckpointError for weights that do not exist."""
    from completion.checkpoints import find_weights
    from pipeline.benchmark.suite import WITHOUT_WEIGHTS
    from pipeline.run_folder.own_methods import is_own, own_class
    from pipeline.run_folder.weights import bundled_names

    if chosen is None:
        return [*WITHOUT_WEIGHTS, *bundled_names("completion")]
    names = _names(chosen, "completion")
    for name in names:
        if is_own("completion", name):
            own_class("completion", name, {})
        elif name not in WITHOUT_WEIGHTS:
            find_weights(name)
    return names


def _names(chosen: str, room: str) -> list[str]:
    """The parts of a,b,c, each once; `bundled` stands for the names of all bundled networks."""
    from pipeline.run_folder.weights import bundled_names

    parts = [part.strip() for part in chosen.split(",") if part.strip()]
    return list(
        dict.fromkeys(name for part in parts for name in (bundled_names(room) if part == "bundled" else [part]))
    )


def _detection_rows(chosen: str | None, threshold: float | None) -> list[Any]:
    """Every detector on the clouds it was trained for, at 64 and at 16 rows."""
    from detection.checkpoints import find_weights, read_card
    from pipeline.benchmark.suite import DetectionRow
    from pipeline.pointcloud.presets import PRESETS
    from pipeline.run_folder.own_methods import is_own, own_class
    from pipeline.run_folder.thresholds import ScoreThresholds

    rows = []
    for name in _names("bundled" if chosen is None else chosen, "detection"):
        if is_own("detection", name):
            # A class says by `cloud` and `score_thresholds` what a card says of weights.
            card = dict(vars(own_class("detection", name, {})))
        else:
            card = read_card(find_weights(name))
        preset = str(card.get("cloud", "L"))
        if preset not in PRESETS:
            raise UsageError(f"{name}: cloud: expected one of {', '.join(PRESETS)}, got {preset!r}")
        least = ScoreThresholds.of_card(card) if threshold is None else ScoreThresholds({}, threshold)
        rows += [DetectionRow(name, preset, number, least) for number in (64, 16)]
    return rows


def _tables(found: dict[str, Any]) -> str:
    """All results as Markdown."""
    tables = {"completion": _completion_tables, "detection": _detection_table, "masks": _mask_table}
    return "\n\n".join("\n".join(table(found)) for name, table in tables.items() if found.get(name)) + "\n"


def _edges(dataset: Dataset, args: argparse.Namespace, progress: Callable[[str], None]) -> int:
    from pipeline.benchmark.edge_ceiling import ceiling_tables, edge_ceiling
    from pipeline.benchmark.suite import row_numbers

    found = edge_ceiling(dataset, row_numbers(args.rows), progress)
    tables = ceiling_tables(found)
    _give(found, tables, args, "edges")
    return 0


def _give(found: Any, tables: str, args: argparse.Namespace, name: str) -> None:
    """Prints what was found as tables or JSON; with --out both go into NAME.md and NAME.json there."""
    text = json.dumps(found, indent=1)
    print(text if args.json else tables)
    if args.out:
        folder = Path(args.out)
        folder.mkdir(parents=True, exist_ok=True)
        write_text(folder / f"{name}.json", text)
        write_text(folder / f"{name}.md", tables)


def _plot(folder: Path, entries: list[dict[str, Any]]) -> None:
    """camera.png: what the camera adds over distance, at 16 rows where they were measured."""
    from pipeline.benchmark.camera import plot_camera

    looked = [entry for entry in entries if "pictures" in entry]
    rows = {entry["rows"] for entry in looked}
    if looked:
        shown = 16 if 16 in rows else max(rows)
        plot_camera(folder / "camera.png", [entry for entry in looked if entry["rows"] == shown])


def _completion_tables(found: dict[str, Any]) -> list[str]:
    from pipeline.benchmark.camera import camera_table

    looked = [entry for entry in found["completion"] if "pictures" in entry]
    return _completion_table(found) + (["", *camera_table(looked, found["frames"])] if looked else [])


def _completion_table(found: dict[str, Any]) -> list[str]:
    lines = [f"Completion on held-out rings, {found['frames']} frames (mm; %; s per frame)", ""]
    lines += ["| rows | method | " + " | ".join(COLUMNS) + " |", "|" + "---|" * (len(COLUMNS) + 2)]
    for entry in sorted(found["completion"], key=lambda e: -e["rows"]):
        numbers = [
            _number(entry[key], 3 if key == "seconds" else (0 if "ae" in key or "rmse" in key else 1))
            for key in COLUMNS
        ]
        lines.append(f"| {entry['rows']} | {entry['method']} | " + " | ".join(numbers) + " |")
    return lines


def _detection_table(found: dict[str, Any]) -> list[str]:
    about = f"{found['frames']} frames, augmented clouds from {found['detection_depth']}"
    lines = [f"Objects found, {about} (found/labelled; precision)", ""]
    lines += ["| detector | cloud | rows | class | overlap | easy | moderate | hard | precision | false |"]
    lines += ["|" + "---|" * 10]
    for entry in found["detection"]:
        for report in entry["reports"]:
            counts = [f"{hit}/{total}" for hit, total in report["found"].values()]
            lines.append(
                f"| {entry['detector']} | {entry['preset']} | {entry['rows']} | {report['class']} | "
                f"{report['metric']} {report['iou']:g} | "
                + " | ".join(counts)
                + f" | {_number(report['precision'], 2)} | {report['false']} |"
            )
    return lines


def _mask_table(found: dict[str, Any]) -> list[str]:
    lines = [f"LiDAR points under masks, {found['frames']} frames (against the points in labelled 3D boxes)", ""]
    lines += ["| mask | group | points in boxes | recall | precision | IoU |", "|" + "---|" * 6]
    for entry in found["masks"]:
        shares = " | ".join(_number(entry[key], 2) for key in ("recall", "precision", "iou"))
        lines.append(f"| {entry['mask']} | {entry['group']} | {entry['boxed']} | {shares} |")
    return lines


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
