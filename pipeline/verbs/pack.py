"""`--stage pack`: a submission archive for the KITTI object server, checked against its rules."""

from __future__ import annotations

import argparse
import errno
import json
import sys
from pathlib import Path

from detection.evaluation.submission import TEST_FRAMES, check_submission, write_archive
from pipeline.base.disk import why_full
from pipeline.base.errors import UsageError

_SHOWN = 20


EXAMPLES = """\
example:
  run_pipeline --stage pack --detections runs/test/detections \\
      --archive submission.zip
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this verb."""
    parser.epilog = EXAMPLES
    parser.add_argument("--detections", required=True, metavar="DIR", help="folder of result files 000000.txt ...")
    parser.add_argument("--archive", default="submission.zip", metavar="FILE", help="zip to write (submission.zip)")
    parser.add_argument(
        "--test-frames",
        type=int,
        default=TEST_FRAMES,
        metavar="N",
        help=f"frames of the test split, numbered from 0 ({TEST_FRAMES})",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of text")
    parser.add_argument("--fill-missing", action="store_true", help="add empty files for frames without a result file")


def run(args: argparse.Namespace) -> int:
    """Check and pack; 0 written, 2 refused (every reason on stderr)."""
    folder = Path(args.detections)
    errors, warnings = check_submission(folder, args.test_frames, args.fill_missing)
    if args.json and errors:
        print(json.dumps({"archive": None, "errors": errors, "warnings": warnings}, indent=1))
    for message in warnings:
        print(f"warning: {message}", file=sys.stderr)
    if errors:
        for message in errors[:_SHOWN]:
            print(f"error: {message}", file=sys.stderr)
        if len(errors) > _SHOWN:
            print(f"error: ... and {len(errors) - _SHOWN} more", file=sys.stderr)
        return 2
    try:
        archive = write_archive(folder, Path(args.archive), args.test_frames)
    except OSError as error:
        what = why_full(args.archive) if error.errno == errno.ENOSPC else error.strerror
        raise UsageError(f"{args.archive}: cannot be written: {what}") from None
    if args.json:
        print(json.dumps({"archive": str(archive), "errors": [], "warnings": warnings}, indent=1))
        return 0
    print(f"{archive}: {args.test_frames} result files at the root, {archive.stat().st_size / 1e6:.1f} MB")
    return 0


def main() -> int:
    """`python -m pipeline.verbs.pack`."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser)
    return run(parser.parse_args())


if __name__ == "__main__":
    sys.exit(main())
