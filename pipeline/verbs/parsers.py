"""The options of the stages and of each verb."""

from __future__ import annotations

import argparse

from pipeline.verbs import verb_module

STAGE_HELP = {
    "synth": "make the synthetic data set",
    "train": "train a network (train.network=completion|detection|segmentation)",
    "complete": "sparse depth + image -> dense depth with two surfaces",
    "augment": "dense depth -> augmented LiDAR",
    "detect": "cloud -> 3D boxes as KITTI result files",
    "evaluate": "AP and depth errors of a run (two folders: --stage evaluate --help)",
    "report": "everything above and one HTML page",
}


EXAMPLES = """\
examples:
  run_pipeline
      the demo: synthetic data, every stage, AP table and report in runs/demo
  run_pipeline --config configs/kitti.yaml --stage detect --data KITTI --out RUN
      depth, twin surfaces, augmented cloud and detections of every frame
  run_pipeline --stage report --out RUN
      scores and report of that run, with its own configuration
  run_pipeline --data KITTI --config configs/kitti.yaml --frames 0:100 --dry-run
      what would be done: frames, files, GB, minutes
  run_pipeline --stage report --out RUN --json result.json
      frames done and failed per stage, scores and paths, for a script
  run_pipeline --stage evaluate --labels LABELS --detections RUN/detections
      AP of any two folders

A command that was stopped or killed continues when it is given again.
Exit codes: 0 done; 1 some frames failed (RUN/failures.json); 2 the request
cannot be carried out.
"""


def verb_parser(verb: str, about: str) -> argparse.ArgumentParser:
    """The options of a verb."""
    parser = argparse.ArgumentParser(
        prog=f"run_pipeline --stage {verb}",
        description=about,
        allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--stage", help=argparse.SUPPRESS)
    verb_module(verb).add_arguments(parser)
    return parser


def main_parser(verbs: dict[str, str]) -> argparse.ArgumentParser:
    """The options of the stages."""
    stages = "".join(f"  {name:<11}{about}\n" for name, about in STAGE_HELP.items())
    others = "".join(f"  {name:<11}{about}\n" for name, about in verbs.items() if name not in STAGE_HELP)
    parser = argparse.ArgumentParser(
        prog="run_pipeline",
        description="Sparse LiDAR + one image -> dense depth -> augmented LiDAR -> 3D detections,\n"
        "scored by KITTI AP. "
        "Without arguments: the demo on synthetic data.",
        epilog=f"stages (a stage runs what it needs before it):\n{stages}\n"
        + (f"verbs (own options: run_pipeline --stage VERB --help):\n{others}\n" if others else "")
        + EXAMPLES,
        allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--config", metavar="FILE", help="configuration (default: the run's own, else configs/synthetic.yaml)")
    add("--stage", metavar="STAGE", help="how far to go; see below (default: everything but train)")
    add("--data", metavar="DIR", help="folder of the data set (data.root)")
    add("--out", metavar="DIR", help="folder of the run (default: runs/demo, or runs/ and the configuration's name)")
    add("--frames", metavar="FILE|a:b|ids", help="split file, positions, or ids separated by commas (data.frames)")
    add("--depth-from", metavar="DIR", help="use these uint16 depth PNGs (ID.png) instead of completing depth")
    add("--set", metavar="key.sub=value", action="append", default=[], dest="overrides", help="change one setting")
    add("--workers", metavar="N", type=_workers, help="processes (default: one per core); results do not depend on it")
    add("--engine", choices=("local", "ray"), default="local", help="where the work is done")
    add(
        "--shard", metavar="i/n", type=_shard, help="every n-th frame from the i-th, counted from 0 (Slurm, Kubernetes)"
    )
    add(
        "--format",
        choices=("html", "png", "pdf", "svg", "rrd", "mcap"),
        help="with --stage report: figures for papers, or recordings for Rerun and Foxglove, beside the page",
    )
    add(
        "--json",
        nargs="?",
        const="-",
        metavar="FILE",
        help="how it went, as JSON: into FILE, or on standard output (everything else then goes to standard error)",
    )
    add("--dry-run", action="store_true", help="print frames, files, GB and minutes; write nothing")
    add(
        "--verify",
        action="store_true",
        help="read every file again to see whether it changed, instead of trusting sizes, times and inodes",
    )
    return parser


def _workers(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a number of processes from 1, got {text!r}")
    return int(text)


def _shard(text: str) -> tuple[int, int]:
    index, slash, count = text.partition("/")
    if not (slash and index.isdigit() and count.isdigit() and int(count) > 0):
        raise argparse.ArgumentTypeError(f"expected i/n, for example 0/4, got {text!r}")
    if int(index) >= int(count):
        raise argparse.ArgumentTypeError(
            f"shards are counted from 0: 0/{count} to {int(count) - 1}/{count}, got {text!r}"
        )
    return int(index), int(count)
