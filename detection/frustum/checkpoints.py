"""Weights of Frustum PointNet: our own files with their card, and the public ones of the original and of the port."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from auglidar_base.array_files import npz_arrays
from auglidar_base.errors import CheckpointError, SettingsError
from detection.checkpoints import load_exactly, load_tensors, read_card, write_card
from detection.frustum.coding import CLASSES
from detection.frustum.network import VARIANTS, FrustumPointNet
from detection.importers import fill, read_tensors

PRESET = "frustum_pointnet"

# TensorFlow scope -> (module, product, normalisation) of our names.
_SCOPES: dict[str, tuple[str, str, str]] = {
    **{f"conv{k}": ("InsSeg", f"conv{k}", f"bn{k}") for k in range(1, 6)},
    **{f"conv{k + 5}": ("InsSeg", f"dconv{k}", f"dbn{k}") for k in range(1, 6)},
    **{f"conv-reg{k}-stage1": ("STN", f"conv{k}", f"bn{k}") for k in range(1, 4)},
    **{f"fc{k}-stage1": ("STN", f"fc{k}", f"fcbn{k}") for k in range(1, 4)},
    **{f"conv-reg{k}": ("est", f"conv{k}", f"bn{k}") for k in range(1, 5)},
    **{f"fc{k}": ("est", f"fc{k}", f"fcbn{k}") for k in range(1, 4)},
}
_NORM = {"gamma": "weight", "beta": "bias", "moving_mean": "running_mean", "moving_variance": "running_var"}


def save_frustum_checkpoint(model: FrustumPointNet, path: str | Path, facts: Mapping[str, Any]) -> Path:
    """Write `path` (.safetensors) and its card (.json beside it), which says the variant and the input channels."""
    options = {"variant": model.variant, "channels": model.channels}
    return write_card(model, {"preset": PRESET, "options": options, "classes": list(CLASSES)}, path, facts)


def load_frustum_checkpoint(path: str | Path, device: str = "cpu") -> FrustumPointNet:
    """The network of our own file, in evaluation mode. Raises CheckpointError saying what is wrong."""
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(
            f"{path}: no such file; expected weights of Frustum PointNet (.safetensors with its card)"
        )
    card = read_card(path)
    if card["preset"] != PRESET:
        raise CheckpointError(f"{path}: weights of {card['preset']!r}; expected Frustum PointNet ({PRESET!r})")
    try:
        model = FrustumPointNet(**card.get("options", {}))
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"{path.with_suffix('.json')}: {error}") from None
    load_exactly(model, load_tensors(path)[0], path)
    return model.to(torch.device(device)).eval()


def import_frustum_pointnet(path: str | Path, variant: str) -> FrustumPointNet:
    """A network in evaluation mode from a public file; nothing in it is executed.

    path     the port's checkpoint, or an .npz of the original's variables under their TensorFlow names
    variant  "tf" or "port": whose mathematics the weights were trained with; shapes do not tell
    Raises SettingsError for another variant, CheckpointError when the file is damaged or does not fit.
    """
    if variant not in VARIANTS:
        raise SettingsError(f"variant: expected one of {', '.join(VARIANTS)}, got {variant!r}")
    tensors = _numpy_variables(Path(path)) if Path(path).suffix == ".npz" else read_tensors(path)
    if any(name.endswith(("/weights", "/weights:0")) for name in tensors):
        tensors = from_tensorflow(tensors)
    first = tensors.get("InsSeg.conv1.weight")
    channels = 4 if first is None or first.dim() < 2 else int(first.shape[1])
    try:
        model = FrustumPointNet(variant, channels)
    except ValueError as error:
        raise CheckpointError(f"{path}: {error}") from None
    fill(model, tensors, path)
    return model.eval()


def _numpy_variables(path: Path) -> dict[str, Tensor]:
    try:
        parts = npz_arrays(path.read_bytes())
        return {name: torch.from_numpy(part.astype(np.float32)) for name, part in parts.items()}
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: expected an .npz of arrays by TensorFlow name ({error})") from None


def from_tensorflow(variables: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Variables "scope/weights", "scope/biases", "scope/bn/gamma", ... under our names, kernels turned to (out, in).

    What belongs to the optimiser (Adam's moments, counters, averages of averages) is left out.
    """
    found: dict[str, Tensor] = {}
    for full, value in variables.items():
        scope, _, rest = full.removesuffix(":0").partition("/")
        kind = rest.split("/")[-1]
        if scope not in _SCOPES or kind.startswith("Adam"):
            continue
        module, product, norm = _SCOPES[scope]
        if rest == "weights":
            found[f"{module}.{product}.weight"] = value.reshape(value.shape[-2:]).t().contiguous()
        elif rest == "biases":
            found[f"{module}.{product}.bias"] = value
        elif kind in _NORM:
            found[f"{module}.{norm}.{_NORM[kind]}"] = value
    return found
