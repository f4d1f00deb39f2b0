"""The command line. Nothing heavy is imported here: `run_pipeline --help` answers at once."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import sys
from collections.abc import Sequence
from typing import Any

from pipeline.errors import DataError, UsageError
from pipeline.verbs import available_verbs, verb_module

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


def main(argv: Sequence[str] | None = None) -> int:
    """The console script; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        return _dispatch(arguments)
    except (UsageError, DataError) as error:
        print(f"run_pipeline: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("run_pipeline: interrupted; the same command continues where it was", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output went away (`run_pipeline ... | head`).
        sys.stderr.close()
        return 1


def _dispatch(arguments: list[str]) -> int:
    stage = _option(arguments, "--stage")
    verbs = available_verbs()
    if stage in verbs and not (stage == "evaluate" and _evaluates_a_run(arguments)):
        return _run_verb(stage, arguments, verbs[stage])
    if stage is not None and stage not in STAGE_HELP:
        known = [*STAGE_HELP, *verbs]
        close = difflib.get_close_matches(stage, known, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(dict.fromkeys(known))}"
        raise UsageError(f"unknown stage {stage!r}; {hint}")
    parser = main_parser(verbs)
    return _run_stages(parser.parse_args(arguments), arguments)


def _option(arguments: Sequence[str], name: str) -> str | None:
    """The value of `name VALUE` or `name=VALUE`, or None."""
    for index, argument in enumerate(arguments):
        if argument == name and index + 1 < len(arguments):
            return arguments[index + 1]
        if argument.startswith(f"{name}="):
            return argument.partition("=")[2]
    return None


def _evaluates_a_run(arguments: Sequence[str]) -> bool:
    """`--stage evaluate` means a run unless two folders are named or its help is asked for."""
    folders = any(argument.split("=")[0] in ("--labels", "--detections") for argument in arguments)
    asks_help = any(argument in ("-h", "--help") for argument in arguments)
    return not folders and not asks_help


def _run_verb(verb: str, arguments: Sequence[str], about: str) -> int:
    result: int = verb_module(verb).run(verb_parser(verb, about).parse_args(arguments))
    return result


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


def _run_stages(args: argparse.Namespace, arguments: Sequence[str]) -> int:
    import json
    from pathlib import Path

    from pipeline.run import Request, carry_out
    from pipeline.runner.atomic import write_text

    overrides = list(args.overrides)
    # JSON strings are YAML strings: a folder called "1e3" or "yes" stays text.
    for key, value in (("data.root", args.data), ("data.frames", args.frames), ("augment.depth_from", args.depth_from)):
        if value is not None:
            overrides.append(f"{key}={json.dumps(value)}")
    if args.format is not None:
        overrides.append(f"report.format={args.format}")
    if args.workers is not None:
        overrides.append(f"run.workers={args.workers}")
    request = Request(
        stage=args.stage,
        config=args.config,
        out=args.out,
        overrides=tuple(overrides),
        shard=args.shard,
        engine=args.engine,
        dry_run=args.dry_run,
        command=("run_pipeline", *arguments),
    )
    if args.json is None:
        return carry_out(request)
    record: dict[str, Any] = {}
    with contextlib.redirect_stdout(sys.stderr if args.json == "-" else sys.stdout):
        code = carry_out(request, record)
    text = json.dumps({"exit_code": code, **record}, indent=1)
    if args.json == "-":
        print(text)
    else:
        write_text(Path(args.json), text + "\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
