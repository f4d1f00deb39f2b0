"""The word for where networks compute, and what it means on this machine."""

from __future__ import annotations

import torch

from auglidar_base.errors import SettingsError

DEVICES = "auto, cpu, cuda, cuda:N or mps"


def check_device(name: str) -> None:
    """SettingsError for a word that no machine knows."""
    kind, colon, index = name.partition(":")
    if name not in ("auto", "cpu", "cuda", "mps") and not (kind == "cuda" and colon and index.isdecimal()):
        raise SettingsError(f"device: expected {DEVICES}, got {name!r}")


def resolve_device(name: str) -> torch.device:
    """The device of a setting; "auto" takes a GPU where there is one, then Apple's, then the CPU.

    Raises SettingsError for an unknown word and for a device that this machine lacks.
    """
    check_device(name)
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "mps" if torch.backends.mps.is_available() else "cpu"
    device = torch.device(name)
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise SettingsError(f"device: {name!r} is not there ({torch.cuda.device_count()} CUDA devices); use 'cpu'")
    if device.type == "mps" and not torch.backends.mps.is_available():
        raise SettingsError("device: 'mps' is not there; use 'cpu'")
    return device
