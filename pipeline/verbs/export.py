"""`--stage export`: a run in another project's layout."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from pipeline.base.errors import UsageError

EXAMPLES = """\
examples:
  run_pipeline --stage export --format virconv --data KITTI \\
      --run runs/kitti --out exports/virconv
  run_pipeline --stage export --format openpcdet --data KITTI \\
      --run runs/kitti --out exports/openpcdet
  run_pipeline --stage export --format sfd --virtual filtered --data KITTI \\
      --run runs/kitti --out exports/sfd
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.epilog = EXAMPLES
    from pipeline.data import READERS
    from pipeline.export.formats import FORMATS
    from pipeline.export.record import VIRTUAL

    formats = "; ".join(f"{name}: {format_.summary}" for name, format_ in FORMATS.items())
    quirks = "; ".join(
        f"{name}: {', '.join(f'{quirk} ({text})' for quirk, text in format_.compat.items())}"
        for name, format_ in FORMATS.items()
        if format_.compat
    )
    parser.add_argument("--format", required=True, choices=list(FORMATS), metavar="NAME", help=formats)
    parser.add_argument(
        "--data", type=Path, required=True, metavar="DIR", help="the data set that the run was made from"
    )
    parser.add_argument("--dataset", default="kitti_object", choices=list(READERS), metavar="NAME", help="its layout "
                        f"(kitti_object): {', '.join(READERS)}")  # fmt: skip
    parser.add_argument("--columns", type=int, metavar="N", help="float32 columns of its .bin clouds (4)")
    parser.add_argument("--run", type=Path, metavar="DIR", help="run folder with depth/, cloud/, detections/")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="output folder")
    parser.add_argument("--frames", metavar="FILE|a:b", help="split file, positions a:b or ids (all frames)")
    parser.add_argument("--virtual", default="dense", choices=VIRTUAL, help="virtual points: every completed pixel, or "
                        "those that the augmentation kept (dense)")  # fmt: skip
    parser.add_argument("--compat", default="", metavar="NAME,...", help=f"consumers' quirks to reproduce. {quirks}")
    parser.add_argument("--images", action="store_true", help="also write the colour images")
    parser.add_argument("--workers", type=int, metavar="N", help="processes (all cores)")
    parser.add_argument("--json", action="store_true", help="print JSON instead of text")


def run(args: argparse.Namespace) -> int:
    """Exports and prints what was written; 0 done, 1 some frames failed. Raises UsageError for a wrong request."""
    from pipeline.data import open_dataset
    from pipeline.export.export import export
    from pipeline.export.record import Options
    from pipeline.export.source import in_run
    from pipeline.export.workers import default_workers

    if args.run is not None and not args.run.is_dir():
        raise UsageError(f"no such run folder: {args.run}")
    dataset = open_dataset(args.dataset, args.data, args.columns)
    if dataset.refusal:
        raise UsageError(dataset.refusal)
    for note in dataset.notes:
        print(f"note: {note}", file=sys.stderr)
    if args.frames:
        dataset = dataset.select(args.frames)
    elif args.run is not None:
        dataset = dataset.select([frame_id for frame_id in dataset.ids if in_run(args.run, frame_id)])
        if not len(dataset):
            raise UsageError(f"{args.run}: no frame of {args.data} in it (expected depth/ID.png or cloud/ID.bin)")
    compat = frozenset(name.strip() for name in args.compat.split(",") if name.strip())
    options = Options(args.virtual, compat, args.images)
    workers = args.workers or default_workers(len(dataset))
    summary = export(dataset, args.run, args.out, args.format, options, workers)
    if args.json:
        print(json.dumps({"out": str(args.out)} | asdict(summary), indent=1, default=str))
        return 1 if summary.failures else 0
    numbers = [f"{summary.frames} frames", *(f"{count} {name}" for name, count in summary.counts.items())]
    numbers += [f"largest {name} {value:.3g}" for name, value in summary.largest.items()]
    print(f"{args.out}: {', '.join(numbers)}")
    for frame_id, reason in summary.failures.items():
        print(f"failed: {frame_id}: {reason}", file=sys.stderr)
    return 1 if summary.failures else 0
