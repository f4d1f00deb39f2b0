"""`--stage evaluate`: KITTI AP of any two folders of label and result files."""

from __future__ import annotations

import argparse
import json
import math
import sys
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TextIO

from auglidar_base.atomic import write_text
from detection.evaluation.protocol import EvaluationProtocol
from pipeline.base.meanings import meanings

if TYPE_CHECKING:
    from detection.evaluation.bootstrap import Resampling
    from detection.evaluation.kitti_ap import Evaluation, Report


# This module is the command line of the distribution auglidar-eval too, under that program's name.
EXAMPLES = """\
examples:
  %(prog)s --labels KITTI/training/label_2 \\
      --detections runs/kitti/detections
  ... --split KITTI/ImageSets/val.txt --classes Car --recall 40 --bootstrap 1000
  ... --explain --json scores.json    why objects are missed; scores for scripts
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this verb."""
    parser.epilog = EXAMPLES
    parser.add_argument("--labels", required=True, metavar="DIR", help="KITTI label files (label_2)")
    parser.add_argument("--detections", required=True, metavar="DIR", help="KITTI result files, one per frame")
    parser.add_argument("--split", metavar="FILE", help="names of the frames to evaluate (every labelled frame)")
    add_protocol(parser.add_argument_group("protocol"))
    parser.add_argument(
        "--missing",
        choices=("error", "skip", "empty"),
        default="error",
        help="a frame without result file: error, leave it out as the official tool, or nothing found",
    )
    parser.add_argument("--lenient", action="store_true", help="pass over broken lines and missing files; count them")
    parser.add_argument("--explain", action="store_true", help="say why every object is matched, missed or ignored")
    parser.add_argument("--bootstrap", type=int, metavar="N", help="confidence intervals from N resamples of frames")
    parser.add_argument("--confidence", type=float, default=0.95, help="of the intervals (0.95)")
    parser.add_argument("--bootstrap-seed", type=int, default=0, metavar="N", help="of the resamples (0)")
    parser.add_argument(
        "--compare",
        action="append",
        default=[],
        metavar="[NAME=]DIR",
        help="another result folder; paired bootstrap differences to --detections; may be repeated",
    )
    parser.add_argument("--curves", metavar="DIR", help="write precision-recall curves and score histograms")
    parser.add_argument("--json", metavar="FILE", help="write the results as JSON; - for stdout")
    parser.add_argument("--markdown", metavar="FILE", help="write the table as Markdown; - for stdout")
    parser.add_argument("--latex", metavar="FILE", help="write the table as LaTeX; - for stdout")


def add_protocol(group: argparse._ArgumentGroup) -> None:
    """One option for every field of `EvaluationProtocol`; an option that is not given leaves the field's default."""
    meaning, hints = meanings(EvaluationProtocol), typing.get_type_hints(EvaluationProtocol)
    for field in fields(EvaluationProtocol):
        option, how = SPELLING.get(field.name, (f"--{field.name.replace('_', '-')}", {}))
        if typing.get_origin(hints[field.name]) is Literal:
            choices = typing.get_args(hints[field.name])
            how = {"choices": choices, "type": type(choices[0]), **how}
        known = f" ({field.default})" if isinstance(field.default, (str, int)) else ""
        text = meaning.get(field.name, "").replace("%", "%%") + known
        group.add_argument(option, dest=field.name, **{"help": text, **how})


def protocol_of(args: argparse.Namespace) -> EvaluationProtocol:
    """The protocol of the options that were given."""
    given = {field.name: getattr(args, field.name) for field in fields(EvaluationProtocol)}
    given = {name: value for name, value in given.items() if value is not None}
    if "ious" in given:
        given["ious"] = _class_ious(given["ious"])
    if "ranges" in given:
        given["ranges"] = [(low, None if math.isinf(high) else high) for low, high in given["ranges"]]
    return EvaluationProtocol(**given)


def _names(text: str) -> list[str]:
    """The parts of a,b,c."""
    return [name.strip() for name in text.split(",") if name.strip()]


# Options that are not simply called and written like their field.
SPELLING: Mapping[str, tuple[str, dict[str, Any]]] = {
    "classes": ("--classes", {"type": _names, "metavar": "Car,..."}),
    "metrics": ("--metrics", {"type": lambda text: _names(text.lower()), "metavar": "2d,..."}),
    "ious": ("--iou", {"action": "append", "metavar": "CLASS=IOU", "help": "instead of the sets; may be repeated"}),
    "ranges": (
        "--range",
        {
            "action": "append",
            "nargs": 2,
            "type": float,
            "metavar": ("LO", "HI"),
            "help": "only LO <= distance < HI metres (HI may be inf); may be repeated",
        },
    ),
    "difficulty": ("--difficulty", {"metavar": "RULE"}),
}


def run(args: argparse.Namespace) -> int:
    """Evaluate and print the table; 0 done, 2 the request cannot be carried out (one line on stderr)."""
    try:
        return _run(args)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _run(args: argparse.Namespace) -> int:
    from detection.evaluation.tables import latex_table, markdown_table

    evaluation = _prepare(args, args.detections)
    report = evaluation.report()
    others = {name: _prepare(args, folder) for name, folder in _named_folders(args.compare, args.detections)}
    # Whoever asks for a machine-readable stdout gets nothing else on it.
    screen = sys.stderr if "-" in (args.json, args.markdown, args.latex) else sys.stdout
    print(markdown_table(report), file=screen)
    result: dict[str, Any] = dict(report)
    if args.bootstrap is not None or others:
        result |= _resample(args, evaluation, others, screen)
    for message in report["warnings"]:
        print(f"WARNING: {message}", file=sys.stderr)
    causes = _causes(evaluation, report)
    for cause in causes:
        print(f"LIKELY CAUSE: {cause}", file=sys.stderr)
    result["causes"] = causes
    if args.explain:
        _explain(evaluation, screen)
    if args.curves:
        _curves(evaluation, Path(args.curves), screen)
    _write(args.json, lambda: json.dumps(result, indent=1, allow_nan=False) + "\n")
    _write(args.markdown, lambda: markdown_table(report))
    _write(args.latex, lambda: latex_table(report["results"]))
    return 0


def _prepare(args: argparse.Namespace, detections: str) -> Evaluation:
    from detection.evaluation.kitti_ap import prepare
    from detection.evaluation.reading import read_split

    frames = read_split(args.split) if args.split else None
    return prepare(
        args.labels, detections, protocol_of(args), frames=frames, missing=args.missing, lenient=args.lenient
    )


def _class_ious(texts: Sequence[str]) -> dict[str, list[float]]:
    """Class -> IoUs from texts such as Car=0.7."""
    ious: dict[str, list[float]] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            ious.setdefault(name, []).append(float(value))
        except ValueError:
            raise ValueError(f"--iou: expected CLASS=IOU such as Car=0.7, got {text!r}") from None
    return ious


def _named_folders(compare: Sequence[str], baseline: str) -> list[tuple[str, str]]:
    """(name, folder) of every --compare; without a name, the folder's, or the run's whose `detections` it is."""
    named = []
    for text in compare:
        name, separator, folder = text.partition("=")
        named.append((name, folder) if separator else (_folder_name(text), text))
    names = [name for name, _ in named] + [_folder_name(baseline)]
    if len(set(names)) != len(names):
        raise ValueError(f"--compare: two result folders are called the same ({', '.join(names)}); use NAME=DIR")
    return named


def _folder_name(folder: str) -> str:
    path = Path(folder).absolute()
    return path.parent.name if path.name == "detections" else path.name


def _resample(
    args: argparse.Namespace, evaluation: Evaluation, others: dict[str, Evaluation], screen: TextIO
) -> dict[str, Any]:
    """Intervals of the baseline, and the differences of the others to it."""
    from detection.evaluation.bootstrap import Resampling, confidence_intervals, paired_differences
    from detection.evaluation.tables import difference_table, interval_table

    resampling: Resampling = Resampling(
        1000 if args.bootstrap is None else args.bootstrap, args.bootstrap_seed, args.confidence
    )
    intervals = confidence_intervals(evaluation, resampling)
    print(interval_table(intervals, resampling.confidence), file=screen)
    found: dict[str, Any] = {"resampling": asdict(resampling), "intervals": [_flat(item) for item in intervals]}
    if others:
        differences = paired_differences({_folder_name(args.detections): evaluation, **others}, resampling)
        print(difference_table(differences, resampling.confidence), file=screen)
        found["differences"] = [_flat(item) for item in differences]
    return found


def _flat(item: Any) -> dict[str, Any]:
    """A row with its target's fields beside its own, named as in the results."""
    row = asdict(item)
    target = row.pop("target")
    return {
        "class": target["cls"],
        "metric": target["metric"],
        "iou": target["iou"],
        "range": list(target["range"]),
        **row,
    }


def _causes(evaluation: Evaluation, report: Report) -> list[str]:
    """Likely causes for every class whose moderate AP is next to nothing, each once."""
    from detection.evaluation.diagnose import likely_causes

    causes: dict[str, None] = {}
    for target, row in zip(evaluation.targets, report["results"]):
        if target.metric != "aos" and (row["moderate"] is None or row["moderate"] < 1):
            causes.update(dict.fromkeys(likely_causes(evaluation.matcher, target)))
    return list(causes)


def _explain(evaluation: Evaluation, screen: TextIO) -> None:
    """Every object at moderate, for the last metric asked for of each class and range at its strictest IoU."""
    from detection.evaluation.explain import explain, orientation_errors, sum_reasons
    from detection.evaluation.tables import METRIC_NAMES, range_text

    metric = evaluation.targets[-1].metric
    for cls, bounds in dict.fromkeys((target.cls, target.range) for target in evaluation.targets):
        candidates = [t for t in evaluation.targets if (t.cls, t.range, t.metric) == (cls, bounds, metric)]
        target = max(candidates, key=lambda t: t.iou)
        lines = explain(evaluation.matcher, target, level=1)
        for line in lines:
            print(line, file=screen)
        where = f"{cls} {METRIC_NAMES[metric]} IoU > {target.iou:g}, {range_text(bounds)}, moderate, any score"
        print(f"\nReasons for {where}", file=screen)
        for side, status, reason, count in sum_reasons(lines):
            print(f"{count:7d}  {side} {status}: {reason}", file=screen)
        errors = orientation_errors(evaluation.matcher, target, level=1)
        if errors is not None:
            print(
                f"Orientation of the matched: mean error {errors[0]:.1f} deg, {errors[1]:.1f} % turned by over 90",
                file=screen,
            )
        print(file=screen)


def _curves(evaluation: Evaluation, folder: Path, screen: TextIO) -> None:
    from detection.evaluation.plots import write_curves

    pictures = find_spec("matplotlib") is not None
    if not pictures:
        print("WARNING: pictures of the curves are left out: they need matplotlib", file=sys.stderr)
    for path in write_curves(evaluation, folder, pictures=pictures):
        print(f"wrote {path}", file=screen)


def _write(place: str | None, text: Callable[[], str]) -> None:
    """Write to a file by atomic rename, or to stdout for "-"."""
    if place is None:
        return
    if place == "-":
        sys.stdout.write(text())
        return
    write_text(Path(place), text())
