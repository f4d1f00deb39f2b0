"""Weights on disk: safetensors with a JSON card beside them, written atomically, and public checkpoints imported."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from auglidar_base.atomic import write_bytes
from auglidar_base.errors import CheckpointError
from detection.models.presets import PRESETS, Preset

WEIGHTS = Path(__file__).parent / "weights"


def save_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None) -> str:
    """Write tensors as safetensors, atomically; returns the file's sha256 in hexadecimal."""
    from safetensors.torch import save

    content = save({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, dict(metadata or {}))
    write_bytes(path, content)
    return hashlib.sha256(content).hexdigest()


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file. Raises CheckpointError naming the file when it is not one."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except SafetensorError as error:
        raise CheckpointError(f"{path}: expected a safetensors file ({error}); is it truncated?") from error


def save_checkpoint(model: nn.Module, preset: Preset, path: str | Path, facts: Mapping[str, Any]) -> Path:
    """Write `path` (.safetensors) and its card (.json beside it), each atomically, weights first.

    facts  added to the card: steps, seed, data, metrics, ...
    """
    identity = {"preset": preset.name, "options": preset.options, "classes": list(preset.classes)}
    return write_card(model, identity, path, facts)


def write_card(model: nn.Module, identity: Mapping[str, Any], path: str | Path, facts: Mapping[str, Any]) -> Path:
    """Write the weights of a network and a card that says which network it is (`identity`) and more `facts`."""
    path = Path(path)
    digest = save_tensors(path, model.state_dict())
    parameters = sum(parameter.numel() for parameter in model.parameters())
    card = {**identity, "parameters": parameters, "sha256": digest, **facts}
    write_bytes(path.with_suffix(".json"), (json.dumps(card, indent=2, sort_keys=True) + "\n").encode())
    return path


def find_weights(path_or_name: str | Path) -> Path:
    """A checkpoint file: an existing path, or the name of bundled weights (detection/weights/NAME.safetensors)."""
    path = Path(path_or_name)
    if path.is_file():
        return path
    bundled = WEIGHTS / f"{path_or_name}.safetensors"
    if bundled.is_file():
        return bundled
    names = ", ".join(sorted(file.stem for file in WEIGHTS.glob("*.safetensors"))) or "none"
    raise CheckpointError(
        f"{path_or_name}: expected a .safetensors file or the name of bundled weights (there are: {names})"
    )


def read_card(weights: Path) -> dict[str, Any]:
    """The card beside a weights file. Raises CheckpointError when it is missing or does not describe these weights."""
    path = weights.with_suffix(".json")
    if not path.is_file():
        raise CheckpointError(f"{weights}: expected its card {path.name} beside it; copy both files together")
    card = json.loads(path.read_text())
    if not isinstance(card, dict) or "preset" not in card:
        raise CheckpointError(f"{path}: expected a JSON object with a 'preset', got something else")
    digest = hashlib.sha256(weights.read_bytes()).hexdigest()
    if card.get("sha256") != digest:
        raise CheckpointError(
            f"{weights}: sha256 is {digest}, its card says {card.get('sha256')}; the file is damaged or mixed up"
        )
    return card


def preset_of(card: Mapping[str, Any], where: str | Path) -> Preset:
    """The preset a card names, with its options."""
    if card["preset"] not in PRESETS:
        raise CheckpointError(f"{where}: unknown preset {card['preset']!r}; known are {', '.join(PRESETS)}")
    return PRESETS[card["preset"]](**card.get("options", {}))


def load_checkpoint(path_or_name: str | Path, device: str = "cpu") -> tuple[nn.Module, Preset, dict[str, Any]]:
    """Model (in eval mode, on `device`), preset and card of our own weights. CheckpointError says what is wrong."""
    weights = find_weights(path_or_name)
    card = read_card(weights)
    preset = preset_of(card, weights)
    model = preset.build()
    load_exactly(model, load_tensors(weights)[0], weights)
    return model.to(torch.device(device)).eval(), preset, card


def load_exactly(model: nn.Module, tensors: Mapping[str, Tensor], where: str | Path) -> None:
    """Load a state dict whose names and shapes must all match. Raises CheckpointError listing what does not."""
    wanted = model.state_dict()
    missing = sorted(wanted.keys() - tensors.keys())
    unknown = sorted(tensors.keys() - wanted.keys())
    misshaped = [
        f"{name}: expected {tuple(wanted[name].shape)}, got {tuple(tensors[name].shape)}"
        for name in sorted(wanted.keys() & tensors.keys())
        if wanted[name].shape != tensors[name].shape
    ]
    if missing or unknown or misshaped:
        parts = [f"missing {missing[:5]}"] * bool(missing) + [f"unknown {unknown[:5]}"] * bool(unknown)
        raise CheckpointError(f"{where}: weights do not fit the network: " + "; ".join([*parts, *misshaped[:5]]))
    model.load_state_dict(dict(tensors))


def import_checkpoint(path: str | Path, architecture: str) -> nn.Module:
    """A network filled with a public checkpoint; see `detection.importers.import_checkpoint`."""
    from detection.importers import import_checkpoint as read

    return read(path, architecture)
