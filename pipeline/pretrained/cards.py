"""Cards of bundled weights: what goes on them, where they are, how they are written."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from auglidar_base.atomic import write_text
from pipeline.base.errors import UsageError
from pipeline.data import open_dataset
from pipeline.pretrained.figures import HeldOut, thresholds
from pipeline.run_folder.weights import bundled_folder

ROOMS = {"completion": "completion", "detection": "detection", "segmentation": "pipeline/semantics"}


def bundled_path(room: str, name: str) -> Path:
    """Where the bundled weights of this name are."""
    return bundled_folder(ROOMS[room]) / f"{name}.safetensors"


def weights_of(room: str, run: Path) -> Path:
    """The weights of a training run. Raises UsageError when it has none."""
    folder = run / "weights" / room
    for name in ("best", "model", "last"):
        if (folder / f"{name}.safetensors").is_file():
            return folder / f"{name}.safetensors"
    raise UsageError(f"{folder}: expected best, model or last .safetensors of a training run, found none")


def read_card(weights: Path) -> dict[str, Any]:
    """The card beside weights."""
    card: dict[str, Any] = json.loads(weights.with_suffix(".json").read_text(encoding="utf-8"))
    return card


def origin(card: dict[str, Any]) -> dict[str, Any]:
    """Seed and hours of a training, which every room notes in a place of its own; hours are None on older cards."""
    training = card["training"]
    places = (card, training, training.get("settings", {}))
    return {key: next((place[key] for place in places if key in place), None) for key in ("seed", "hours")}


def measured(room: str, weights: Path, held_out: HeldOut) -> dict[str, Any]:
    """The entries of a card that come from the held-out frames."""
    figures = held_out.figures(room, weights)
    if room != "detection":
        return {"held_out": figures}
    return {"held_out": figures, "cloud": held_out.cloud, "score_thresholds": thresholds(figures)}


def write_card(weights: Path, card: dict[str, Any]) -> None:
    """Write the card of weights without the places of this machine."""
    text = json.dumps(without_places(card), indent=1, sort_keys=True) + "\n"
    write_text(weights.with_suffix(".json"), text)


def without_places(value: Any) -> Any:
    """The card with folders of the machine it was made on cut down to their last name."""
    if isinstance(value, dict):
        return {key: without_places(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [without_places(inner) for inner in value]
    return Path(value).name if isinstance(value, str) and Path(value).is_absolute() else value


def parser_of(program: str, text: str | None) -> argparse.ArgumentParser:
    """What both commands are told: a run, a name, and the frames to measure on."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {program}", description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("room", choices=tuple(ROOMS))
    parser.add_argument("run", type=Path, help="folder of the training run")
    parser.add_argument("name", help="name of the bundled weights")
    add_held_out(parser)
    return parser


def add_held_out(parser: argparse.ArgumentParser) -> None:
    """The frames to measure on, and for detectors the clouds they are given."""
    parser.add_argument("--data", required=True, help="held-out synthetic data set in KITTI object layout")
    parser.add_argument("--frames", default="0:", help="frames of it (default: all)")
    parser.add_argument("--cloud", default="L", help="detection: preset of the clouds it was trained on")
    parser.add_argument("--completer", default="classical", help="detection: completion for augmented clouds")


def held_out_of(args: argparse.Namespace) -> HeldOut:
    """The frames that the arguments of `parser_of` ask for."""
    return HeldOut(open_dataset("kitti_object", args.data).select(args.frames), args.cloud, args.completer)
