"""`--stage import`: public weights as our safetensors, result pickles of other projects as KITTI result files."""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from auglidar_base.errors import CheckpointError, SettingsError
from pipeline.base.errors import DataError, UsageError

if TYPE_CHECKING:
    from pipeline.verbs.results import ImportedResults

# The published network whose features the segmentation network of `pipeline.semantics.pyramid` stands on.
BACKBONE = "efficientnet_lite0"
FRUSTUM = "frustum_pointnet"

EXAMPLES = """\
examples:
  run_pipeline --stage import TWISE.tar --architecture twise \\
      --out weights/twise.safetensors
  run_pipeline --stage import result.pkl --architecture results --out detections
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.epilog = EXAMPLES
    parser.add_argument(
        "path", type=Path, metavar="FILE", help="a checkpoint, or a result pickle of OpenPCDet or mmdetection3d"
    )
    parser.add_argument(
        "--architecture",
        required=True,
        metavar="NAME",
        help="twise, twise_maxpool, msg_chn, msg_chn_wacv, sparse_to_dense, nlspn, enet, penet; pointrcnn, epnet, "
        "openpcdet_pointrcnn, pointpillar, second, voxel_rcnn, pv_rcnn, frustum_pointnet; efficientnet_lite0 (backbone "
        "to train a segmentation network on); or 'results' for a result pickle",
    )
    parser.add_argument(
        "--choose",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="what the file does not tell, repeatable; nlspn: legacy and preserve_input, both true for the authors' "
        "released weights, and affinity (AS, ASS, TC, TGASS), iterations (18); enet, penet: crop "
        "(bottom, top_left) and camera (published, frame); frustum_pointnet: variant, tf (the original) or port",
    )
    out = "NAME.safetensors, or the folder of result files"
    parser.add_argument("--out", type=Path, required=True, metavar="FILE|DIR", help=out)
    parser.add_argument("--json", action="store_true", help="print JSON instead of text")


def run(args: argparse.Namespace) -> int:
    """Imports and says what was written. Raises UsageError for an unknown architecture, DataError for a bad file."""
    if not args.path.is_file():
        raise UsageError(f"no such file: {args.path}")
    if args.architecture == "results":
        imported = import_results(args.path, args.out)
        count, notes = len(imported.frames), imported.notes
        record = {"out": str(args.out), "files": count, "notes": list(notes)}
        print(json.dumps(record) if args.json else "\n".join([f"{args.out}: {count} result files", *notes]))
        return 0
    if args.out.suffix != ".safetensors":
        raise UsageError(f"--out {args.out}: expected a name that ends in .safetensors")
    written = import_weights(args.path, args.architecture, args.out, parsed_choices(args.choose))
    card = written.with_suffix(".json")
    print(json.dumps({"weights": str(written), "card": str(card)}) if args.json else f"{written} and {card.name}")
    return 0


def parsed_choices(given: list[str]) -> dict[str, object]:
    """NAME=VALUE pairs; true, false and whole numbers as such. Raises UsageError for anything else than a pair."""
    found: dict[str, object] = {}
    for pair in given:
        name, equals, value = pair.partition("=")
        if not (name and equals and value):
            raise UsageError(f"--choose {pair}: expected NAME=VALUE, e.g. legacy=true")
        truth = {"true": True, "false": False}.get(value.lower())
        found[name] = truth if truth is not None else int(value) if value.isdecimal() else value
    return found


def import_weights(path: Path, architecture: str, out: Path, choices: Mapping[str, object] | None = None) -> Path:
    """Writes a public checkpoint as safetensors with a card; nothing in the file is executed.

    choices  what the file does not tell, see `completion.checkpoints.import_checkpoint`

    Raises UsageError for an unknown architecture and for choices that are missing or not offered, DataError
    when the file does not fit it.
    """
    from completion.importers import ARCHITECTURES
    from detection.models.presets import IMPORTED_PRESETS

    known = (*ARCHITECTURES, *IMPORTED_PRESETS, FRUSTUM, BACKBONE)
    if architecture not in known:
        raise UsageError(f"unknown architecture {architecture!r}; known: {', '.join(known)}, results")
    try:
        if architecture in ARCHITECTURES:
            from completion.checkpoints import convert_checkpoint

            return convert_checkpoint(path, architecture, out, **(choices or {}))
        if architecture == FRUSTUM:
            return _import_frustum(path, out, dict(choices or {}))
        if choices:
            raise UsageError(f"--choose: {architecture} leaves nothing to choose")
        if architecture == BACKBONE:
            return _import_backbone(path, out)
        return _import_detector(path, architecture, out)
    except SettingsError as error:
        raise UsageError(str(error)) from None
    except CheckpointError as error:
        # The libraries name the file as well; once is enough.
        raise DataError(path, f"a checkpoint of {architecture}", str(error).removeprefix(f"{path}: ")) from None


def _import_backbone(path: Path, out: Path) -> Path:
    """A segmentation network with the published backbone and a pyramid that has learned nothing yet."""
    import torch

    from auglidar_base.torch_pickle import read_torch_pickle
    from pipeline.semantics.checkpoints import save_segmenter
    from pipeline.semantics.efficientnet_lite import backbone_state
    from pipeline.semantics.pyramid import PyramidSegmenter

    state = backbone_state(read_torch_pickle(path))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = PyramidSegmenter()
    model.backbone.load_state_dict(state)
    source = {"imported_from": path.name, "source_sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    return save_segmenter(model, out, source)


def _import_detector(path: Path, architecture: str, out: Path) -> Path:
    from detection.checkpoints import import_checkpoint, save_checkpoint
    from detection.models.presets import IMPORTED_PRESETS

    model = import_checkpoint(path, architecture)
    facts = {
        "imported_from": path.name,
        "source_sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "architecture": architecture,
    }
    return save_checkpoint(model, IMPORTED_PRESETS[architecture](model), out, facts)


def _import_frustum(path: Path, out: Path, choices: dict[str, object]) -> Path:
    from detection.frustum.checkpoints import import_frustum_pointnet, save_frustum_checkpoint

    variant = str(choices.pop("variant", ""))
    if choices or variant not in ("tf", "port"):
        raise UsageError(
            "frustum_pointnet: give --choose variant=tf (the original) or variant=port (the common PyTorch port), and "
            "nothing else; the files have equal shapes, but the two compute different things"
        )
    source = {"imported_from": path.name, "source_sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    return save_frustum_checkpoint(import_frustum_pointnet(path, variant), out, source)


def import_results(path: Path, out: Path) -> ImportedResults:
    """Result pickles of OpenPCDet and mmdetection3d as one KITTI result file per frame; gives what was written.

    The pickle is read by an unpickler that knows containers and arrays only. Frames without objects give empty files.
    Raises DataError when an entry lacks a field, comes twice or holds NaN; then nothing is written.
    """
    from pipeline.check.safe_pickle import load_infos
    from pipeline.data.kitti_object import write_objects
    from pipeline.verbs.results import read_results

    imported = read_results(load_infos(path), path)
    for name, objects in imported.frames.items():
        write_objects(out / f"{name}.txt", objects)
    return imported
