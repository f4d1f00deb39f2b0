"""The state of a training run in one safetensors file: network, optimiser, counters. Written atomically, no pickle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from auglidar_base.atomic import write_bytes
from auglidar_base.errors import CheckpointError
from auglidar_base.versions import own_version, state_of_another_version

FORMAT = "auglidar-completion-run-2"


def save_state(
    path: Path, model: nn.Module, optimiser: torch.optim.Optimizer, scaler: torch.amp.GradScaler, facts: dict[str, Any]
) -> None:
    """Write everything a bit-exact continuation needs. `facts` is JSON: step, best score, identity of the settings."""
    tensors: dict[str, Tensor] = {f"model/{name}": value.detach() for name, value in model.state_dict().items()}
    numbers: dict[str, dict[str, float]] = {}
    for index, state in optimiser.state_dict()["state"].items():
        for name, value in state.items():
            if isinstance(value, Tensor):
                tensors[f"optimiser/{index}/{name}"] = value.detach()
            else:
                numbers.setdefault(str(index), {})[name] = value
    header = {
        "format": FORMAT,
        "version": own_version(),
        "facts": facts,
        "optimiser_numbers": numbers,
        "scaler": scaler.state_dict(),
    }
    stored = {name: value.cpu().contiguous() for name, value in tensors.items()}
    write_bytes(path, save_tensors(stored, {"run": json.dumps(header)}))


def load_state(
    path: Path, model: nn.Module, optimiser: torch.optim.Optimizer, scaler: torch.amp.GradScaler
) -> dict[str, Any]:
    """Restore model, optimiser and scaler in place; returns the facts.

    CheckpointError when the file is not of this network, or of an earlier version.
    """
    with safe_open(path, "pt") as file:
        header = json.loads((file.metadata() or {}).get("run", "{}"))
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    found = str(header.get("format"))
    if not found.startswith("auglidar-completion-run-"):
        raise CheckpointError(f"{path}: expected the state of a training run ({FORMAT}), got {found}")
    if found != FORMAT:
        raise state_of_another_version(path, found, FORMAT, header.get("version"))
    try:
        model.load_state_dict(
            {name.removeprefix("model/"): t for name, t in tensors.items() if name.startswith("model/")}
        )
    except RuntimeError as error:
        raise CheckpointError(f"{path}: the state is of another network: {error}") from error
    state: dict[int, dict[str, Any]] = {int(k): dict(v) for k, v in header["optimiser_numbers"].items()}
    for name, tensor in tensors.items():
        if name.startswith("optimiser/"):
            _, index, key = name.split("/", 2)
            state.setdefault(int(index), {})[key] = tensor
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
    scaler.load_state_dict(header["scaler"])
    facts: dict[str, Any] = header["facts"]
    return facts
