"""Segmentation networks in files: safetensors and a card beside them that names the network and the file's hash."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from auglidar_base.atomic import write_bytes
from pipeline.base.errors import DataError
from pipeline.semantics.conventions import CLASSES
from pipeline.semantics.inference import NetworkSegmenter, SegmentationNetwork
from pipeline.semantics.network import StreetSegmenter
from pipeline.semantics.pyramid import PyramidSegmenter

WEIGHTS = Path(__file__).parent / "weights"
# A card's "architecture" -> the network.
ARCHITECTURES: dict[str, type[SegmentationNetwork]] = {
    "StreetSegmenter": StreetSegmenter,
    "PyramidSegmenter": PyramidSegmenter,
}


def save_segmenter(
    model: SegmentationNetwork, out: Path, training: dict[str, Any], thresholds: Mapping[str, float] | None = None
) -> Path:
    """Write OUT.safetensors and its card OUT.json, with the thresholds that `load_segmenter` takes by default.

    Values are rounded to the network's `stored` type.
    """
    from safetensors.torch import save

    weights = out.with_suffix(".safetensors")
    state = model.state_dict().items()
    content = save({name: _rounded(value, model.stored).contiguous() for name, value in state})
    write_bytes(weights, content)
    card = {
        "architecture": type(model).__name__,
        "sha256": hashlib.sha256(content).hexdigest(),
        "classes": list(CLASSES),
        "convention": "cityscapes_trainIds",
        "data": "synthetic street scenes of this project",
        **({"origin": model.origin} if model.origin else {}),
        **({"thresholds": dict(thresholds)} if thresholds else {}),
        "training": training,
    }
    write_bytes(out.with_suffix(".json"), (json.dumps(card, indent=2) + "\n").encode())
    return weights


def _rounded(value: torch.Tensor, stored: torch.dtype) -> torch.Tensor:
    return value.to(stored) if value.is_floating_point() else value


def load_segmenter(path_or_name: str | Path, thresholds: Mapping[str, float] | None = None) -> NetworkSegmenter:
    """Weights from a .safetensors file, or bundled ones by name ("street-small"), ready for images.

    thresholds  score from which a pixel belongs to a group ("vehicles", "people"); those of the card where not given

    Raises DataError when there are no weights, when they are not those of their card, or of another network;
    ValueError for thresholds of other groups or outside [0, 1].
    """
    model, card = read_segmenter(path_or_name)
    return NetworkSegmenter(model, {**card.get("thresholds", {}), **(thresholds or {})})


def read_segmenter(path_or_name: str | Path) -> tuple[SegmentationNetwork, dict[str, Any]]:
    """The network as it was saved (for more training), and its card. Raises DataError as `load_segmenter` does."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    path = Path(path_or_name)
    path = path if path.suffix == ".safetensors" else WEIGHTS / f"{path_or_name}.safetensors"
    if not path.is_file():
        have = ", ".join(sorted(file.stem for file in WEIGHTS.glob("*.safetensors"))) or "none"
        raise DataError(path, "weights of a segmentation network", "no such file", f"bundled: {have}")
    content, card = path.read_bytes(), _read_card(path.with_suffix(".json"))
    found = hashlib.sha256(content).hexdigest()
    if found != card["sha256"]:
        raise DataError(path, f"SHA-256 {card['sha256'][:12]}... as its card says", f"{found[:12]}...")
    # Cards before the second network do not always name the first.
    name = card.get("architecture", "StreetSegmenter")
    if name not in ARCHITECTURES:
        raise DataError(path, f"one of the networks {', '.join(ARCHITECTURES)}", f"{name!r} on its card")
    model = ARCHITECTURES[name]()
    try:
        model.load_state_dict(load(content))
    except (RuntimeError, SafetensorError) as error:
        raise DataError(path, f"weights of {name}", str(error).splitlines()[0]) from None
    return model, card


def _read_card(path: Path) -> dict[str, Any]:
    """The card of weights. Raises DataError without a card or a hash in it."""
    try:
        card = json.loads(path.read_text(encoding="utf-8"))
    except OSError:
        raise DataError(path, "the card of the weights beside them", "no such file") from None
    except ValueError:
        card = None
    if not isinstance(card, dict) or not isinstance(card.get("sha256"), str):
        raise DataError(path, "a JSON object with the SHA-256 of the weights", "none")
    return card
