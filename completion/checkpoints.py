"""Weights on disk: NAME.safetensors and NAME.json, a card that says which network they fit and how they were made.

Both are written by atomic rename. The card holds the SHA-256 of the weights; a file that does not match its card, or
tensors that do not match the network, are refused.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import nn

from auglidar_base.atomic import write_bytes
from auglidar_base.errors import CheckpointError
from completion.decoding import default_decoding
from completion.importers import import_checkpoint, import_with_spec
from completion.models import ModelSpec, build_model
from completion.state_dicts import fill, match

__all__ = [
    "Card",
    "CheckpointError",
    "convert_checkpoint",
    "import_checkpoint",
    "load_checkpoint",
    "save_checkpoint",
]

FORMAT = "auglidar-completion-1"
WEIGHTS = Path(__file__).resolve().parent / "weights"
# Names of tensors in files of earlier versions -> their names now.
_EARLIER = {"convtf.weight": "convtf.0.weight", "convtf.bias": "convtf.0.bias"}


@dataclass(frozen=True)
class Card:
    """What a checkpoint is.

    model      how to rebuild the network and scale its inputs
    decoding   how one depth is read from the output by default (see twin_surface.DECODINGS; "all" or "peak" for DC)
    training   free facts: data, seeds, command, hours, metrics, limits, or the source of imported weights
    sha256     of the safetensors file
    """

    model: ModelSpec
    decoding: str = "fused"
    training: Mapping[str, Any] = field(default_factory=dict)
    sha256: str = ""


def save_checkpoint(path: str | Path, model: nn.Module, card: Card) -> Path:
    """Write PATH.safetensors and PATH.json (any suffix of `path` is replaced); returns the safetensors path."""
    weights_path = Path(path).with_suffix(".safetensors")
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()}
    content = save_tensors(tensors)
    described = {
        "format": FORMAT,
        "sha256": hashlib.sha256(content).hexdigest(),
        "model": asdict(card.model),
        "decoding": card.decoding,
        "training": dict(card.training),
    }
    write_bytes(weights_path, content)
    write_bytes(weights_path.with_suffix(".json"), json.dumps(described, indent=1).encode())
    return weights_path


def find_weights(path_or_name: str | Path) -> Path:
    """The .safetensors file of a path (suffix optional) or of a bundled name. CheckpointError if there is none."""
    given = Path(path_or_name)
    for candidate in (given.with_suffix(".safetensors"), WEIGHTS / f"{path_or_name}.safetensors"):
        if candidate.is_file():
            return candidate
    bundled = ", ".join(sorted(file.stem for file in WEIGHTS.glob("*.safetensors"))) or "none"
    raise CheckpointError(
        f"{path_or_name}: no such weights; give the path of a .safetensors file or one of: classical, {bundled}"
    )


def read_card(weights_path: Path) -> Card:
    """The card beside a safetensors file. CheckpointError when it is missing, damaged or of another format."""
    path = weights_path.with_suffix(".json")
    if not path.is_file():
        raise CheckpointError(f"{weights_path}: its card {path.name} is missing; both files belong together")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise CheckpointError(f"{path}: expected format {FORMAT!r}, got {content['format']!r}")
        spec = ModelSpec(**content["model"])
        # Cards written before version 0.2 say "read_out".
        decoding = content["decoding"] if "decoding" in content else content["read_out"]
        return Card(spec, str(decoding), dict(content["training"]), str(content["sha256"]))
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"{path}: not a card of a completion network: {error}") from error


def load_checkpoint(path_or_name: str | Path) -> tuple[nn.Module, Card]:
    """The network in evaluation mode on the CPU, and its card.

    CheckpointError when the file was changed since its card was written, is damaged, or does not fit its network.
    """
    weights_path = find_weights(path_or_name)
    card = read_card(weights_path)
    content = weights_path.read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if found != card.sha256:
        raise CheckpointError(
            f"{weights_path}: SHA-256 is {found[:12]}..., its card says {card.sha256[:12]}...; "
            "the file is damaged or not this card's"
        )
    try:
        tensors = {_EARLIER.get(name, name): value for name, value in load_tensors(content).items()}
    except SafetensorError as error:
        raise CheckpointError(f"{weights_path}: not a readable safetensors file: {error}") from error
    model = _fitting_model(card.model, tensors, weights_path)
    fill(model, tensors, str(weights_path))
    return model.eval(), card


def _fitting_model(spec: ModelSpec, tensors: Mapping[str, torch.Tensor], path: Path) -> nn.Module:
    """A network of the card's kind that these tensors fit; a card of absurd size is refused before memory is taken."""
    try:
        with torch.device("meta"):
            found = match(build_model(spec), tensors)
        if found.fits:
            with torch.random.fork_rng(devices=[]):
                return build_model(spec)
    except (TypeError, ValueError, RuntimeError, IndexError, KeyError, ArithmeticError) as error:
        raise CheckpointError(
            f"{path.with_suffix('.json')}: no network can be built from this card: {error}"
        ) from error
    raise CheckpointError(f"{path}: does not fit the network of its card: {found}")


def convert_checkpoint(path: str | Path, architecture: str, out: str | Path, **choices: object) -> Path:
    """Import a published file (see `import_checkpoint`) and write it with a card; returns the safetensors path."""
    model, spec, facts = import_with_spec(path, architecture, **choices)
    return save_checkpoint(out, model, Card(spec, default_decoding(spec), facts))
