"""`--stage check`: the data doctor, the leakage check, and difficulty counts of Virtual KITTI 2."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from pipeline.base.errors import UsageError

EXAMPLES = """\
examples:
  run_pipeline --stage check KITTI
  run_pipeline --stage check runs/kitti --data KITTI
  run_pipeline --stage check DEPTH --format depth --data KITTI \\
      --json report.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.epilog = EXAMPLES
    from pipeline.check.doctor import FORMATS
    from pipeline.check.leakage import BUILT_IN
    from pipeline.data import READERS
    from pipeline.data.vkitti2_difficulty import RULES

    parser.add_argument("path", nargs="?", type=Path, metavar="PATH", help="data set, run or exported folder to check")
    parser.add_argument("--data", type=Path, metavar="DIR", help="the data set PATH was made from; checked itself when "
                        "no PATH is given")  # fmt: skip
    parser.add_argument("--dataset", choices=list(READERS), metavar="NAME", help="layout of --data (found out when not "
                        f"given): {', '.join(READERS)}")  # fmt: skip
    parser.add_argument("--format", choices=FORMATS, metavar="NAME", help="format of PATH (found out when not given): "
                        f"{', '.join(FORMATS)}")  # fmt: skip
    parser.add_argument("--frames", metavar="FILE|a:b", help="split file, positions a:b or ids (all frames)")
    parser.add_argument("--columns", type=int, metavar="N", help="float32 columns of the .bin clouds of a data set (4)")
    parser.add_argument("--workers", type=int, metavar="N", help="processes (all cores)")
    parser.add_argument("--json", nargs="?", const="-", metavar="FILE", help="write the report as JSON (to the screen)")
    leakage = parser.add_argument_group("leakage: frames that share a raw drive with a model's training data")
    leakage.add_argument("--leakage", action="store_true", help="check --frames (all frames of the mapping)")
    leakage.add_argument("--mapping", type=Path, metavar="DIR", help="folder with train_mapping.txt and train_rand.txt")
    leakage.add_argument("--train-list", metavar="FILE|DIR", help="drives or frames of the training data, a folder of "
                         f"drives, or {BUILT_IN}")  # fmt: skip
    counts = parser.add_argument_group("Virtual KITTI 2: splits and difficulty counts of the thesis")
    counts.add_argument("--difficulty", action="store_true", help="count easy, medium and hard objects of each split")
    counts.add_argument("--occlusion", choices=(*RULES, "all"), default="all", help="rule for the occlusion (all)")
    counts.add_argument("--classes", default="Car", metavar="A,B", help="labels to count (Car)")


def run(args: argparse.Namespace) -> int:
    """0 nothing wrong, 1 something found. Raises UsageError when the request cannot be carried out."""
    if args.leakage:
        return _leakage(args)
    if args.difficulty:
        return _difficulty(args)
    from pipeline.check.doctor import check, open_checked, recognise

    path = args.path or args.data
    if path is None:
        raise UsageError("nothing to check: give a PATH or --data DIR")
    reference = None
    if args.path is not None and args.data is not None:
        reference = open_checked(args.dataset or recognise(args.data), args.data, args.columns)
    format_name = args.format or (args.dataset if args.path is None else None)
    report = check(path, format_name, reference, args.frames, args.workers, columns=args.columns)
    _show(args.json, report.as_dict(), list(report.lines()))
    return 0 if report.clean else 1


def _show(target: str | None, record: dict[str, object], lines: list[str]) -> None:
    """The report as text, as JSON on the screen, or as text with JSON in a file."""
    from auglidar_base.atomic import write_text

    text = json.dumps(record, indent=1)
    if target == "-":
        print(text)
        return
    if target is not None:
        write_text(Path(target), text + "\n")
    print("\n".join(lines))


def _leakage(args: argparse.Namespace) -> int:
    from pipeline.check.leakage import find_leakage, read_mapping, read_training
    from pipeline.data.dataset import read_split

    if args.mapping is None or args.train_list is None:
        raise UsageError("--leakage needs --mapping DIR and --train-list FILE")
    mapping = read_mapping(args.mapping)
    training = read_training(args.train_list, mapping)
    frames = read_split(Path(args.frames)) if args.frames else list(mapping)
    result = find_leakage(frames, mapping, training)
    lines = [f"{len(result.shared_drive)} of {result.frames} frames share a raw drive with the training data"]
    lines.append(f"{len(result.shared_frame)} of them were in the training data themselves")
    lines += [f"  {drive}: {count}" for drive, count in result.drives.items()]
    _show(args.json, result.as_dict(), lines)
    return 1 if result.shared_drive else 0


def _difficulty(args: argparse.Namespace) -> int:
    from pipeline.data.vkitti2 import open_vkitti2, thesis_split
    from pipeline.data.vkitti2_difficulty import RULES, count_difficulties

    root = args.path or args.data
    if root is None:
        raise UsageError("--difficulty needs the Virtual KITTI 2 folder: give a PATH or --data DIR")
    dataset = open_vkitti2(root)
    classes = [name.strip() for name in args.classes.split(",") if name.strip()]
    rules = RULES if args.occlusion == "all" else (args.occlusion,)
    record: dict[str, object] = {"classes": classes, "splits": {}}
    splits: dict[str, object] = {}
    lines = [f"{'split':<16} {'frames':>7} {'occlusion':>10} {'easy':>7} {'medium':>7} {'hard':>7} {'ignored':>8}"]
    for name in ("train", "test", "test_completion"):
        split = thesis_split(dataset, name)
        counts = {rule: count_difficulties(Path(root), split.ids, rule, classes) for rule in rules}
        splits[name] = {"frames": len(split), "counts": counts}
        for rule, levels in counts.items():
            numbers = f"{levels['easy']:>7} {levels['medium']:>7} {levels['hard']:>7} {levels['ignored']:>8}"
            lines.append(f"{name:<16} {len(split):>7} {rule:>10} {numbers}")
    record["splits"] = splits
    _show(args.json, record, lines)
    return 0
