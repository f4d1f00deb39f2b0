"""Filling a network with named tensors, strictly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor, nn

from auglidar_base.errors import CheckpointError


@dataclass(frozen=True)
class Match:
    """How a set of named tensors fits a network: three lists of readable lines, all empty when it fits."""

    missing: tuple[str, ...]
    unknown: tuple[str, ...]
    misshapen: tuple[str, ...]

    @property
    def fits(self) -> bool:
        return not (self.missing or self.unknown or self.misshapen)

    def __str__(self) -> str:
        lines = [f"missing {name}" for name in self.missing] + [f"unknown {name}" for name in self.unknown]
        lines += self.misshapen
        return "; ".join(lines[:8]) + (f"; and {len(lines) - 8} more" if len(lines) > 8 else "")


def match(model: nn.Module, tensors: Mapping[str, Tensor]) -> Match:
    """Compare names and shapes with the network's."""
    own = model.state_dict()
    return Match(
        tuple(name for name in own if name not in tensors),
        tuple(name for name in tensors if name not in own),
        tuple(
            f"{name} is {tuple(tensors[name].shape)}, the network has {tuple(value.shape)}"
            for name, value in own.items()
            if name in tensors and tensors[name].shape != value.shape
        ),
    )


def fill(model: nn.Module, tensors: Mapping[str, Tensor], where: str) -> None:
    """Copy tensors into the model in place. CheckpointError naming missing, unknown and misshapen ones."""
    found = match(model, tensors)
    if not found.fits:
        raise CheckpointError(f"{where}: does not fit this network of {len(model.state_dict())} tensors: {found}")
    model.load_state_dict(dict(tensors))
