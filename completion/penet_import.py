"""What the published files of ENet and PENet hold beside the network, and what is chosen when they are read."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from auglidar_base.errors import CheckpointError, SettingsError
from completion.models import ModelSpec, default_spec
from completion.models.enet import CAMERAS, CROPS, WIDTH
from completion.models.geometric import ENCODINGS

CHOICES = {"crop": CROPS, "camera": CAMERAS}
# The training class' attention, whose output has no effect, and the constant kernels that only shift.
UNUSED = ("dimhalf_s2.", "att_12.", "encoder3", "encoder5", "encoder7")


def without_unused(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors that compute."""
    return {name: value for name, value in tensors.items() if not name.startswith(UNUSED)}


def penet_spec(architecture: str, tensors: Mapping[str, Tensor], choices: Mapping[str, object]) -> ModelSpec:
    """The network of a file: encoding, width and dilation from its tensors.

    choices  crop (default "bottom") and camera (default "published"), see `completion.windows`
    SettingsError for a choice that is none, CheckpointError for a file of the other network.
    """
    for name, value in choices.items():
        if name not in CHOICES:
            raise SettingsError(f"{architecture}: expected choices among {', '.join(CHOICES)}, got {name}")
        if value not in CHOICES[name]:
            raise SettingsError(f"{architecture}: {name}: expected one of {', '.join(CHOICES[name])}, got {value!r}")
    prefixed = any(name.startswith("backbone.") for name in tensors)
    if prefixed != (architecture == "penet") and any("rgb_conv_init" in name for name in tensors):
        other = "penet" if prefixed else "enet"
        raise CheckpointError(f"these are weights of {other}, not of {architecture}; import them as {other!r}")
    start = "backbone." if prefixed else ""
    width = _size(tensors, f"{start}rgb_conv_init.0.weight", 0) or WIDTH
    extra = _size(tensors, f"{start}rgb_encoder_layer1.conv1.weight", 1) - width
    encoding = next((name for name, count in ENCODINGS.items() if count == extra), "xyz")
    arguments: dict[str, object] = {"encoding": encoding, "width": width, **choices}
    if architecture == "penet":
        arguments["dilation"] = _dilation(tensors)
    return default_spec(architecture, **arguments)


def _size(tensors: Mapping[str, Tensor], name: str, axis: int) -> int:
    found = tensors.get(name)
    return int(found.shape[axis]) if found is not None and found.ndim == 4 else 0


def _dilation(tensors: Mapping[str, Tensor]) -> int:
    if any(name.startswith("iter_conf_layer") for name in tensors):
        return 1
    return 4 if any("_s3." in name for name in tensors) else 2
