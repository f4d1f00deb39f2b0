"""The console script `auglidar-eval`: the options and the JSON of AugLiDAR's `run_pipeline --stage evaluate`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.metadata import version

from auglidar_eval.pipeline.verbs import evaluate


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code: 0 done, 2 the request cannot be carried out."""
    parser = argparse.ArgumentParser(
        prog="auglidar-eval",
        description="KITTI average precision of two folders of label and result files.",
        allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {version('auglidar-eval')}")
    evaluate.add_arguments(parser)
    return evaluate.run(parser.parse_args(argv))
