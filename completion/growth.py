"""Starting a network from another: from a narrower one of its kind, or from one with another head."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from auglidar_base.errors import SettingsError


def grow(narrow: nn.Module, wide: nn.Module) -> list[str]:
    """Copy `narrow` into the leading channels of `wide`; returns the names of the tensors that are larger there.

    The first outputs of every layer read none of the added inputs, so the old channels, and with them the network's
    output, stay what they were; added channels keep the values `wide` was built with and join in as soon as training
    moves the zeros (function-preserving widening as in Net2Net, Chen et al. 2016, without its copied units).
    Holds for networks of convolutions and point-wise operations whose channels keep their order.
    Raises ValueError when the names differ or a tensor of `wide` is smaller.
    """
    known, wanted = narrow.state_dict(), wide.state_dict()
    if known.keys() != wanted.keys():
        raise SettingsError(f"warm start: the networks differ in {sorted(known.keys() ^ wanted.keys())[:5]}")
    grown = []
    for name, value in wanted.items():
        old = known[name]
        if old.dim() != value.dim() or any(a > b for a, b in zip(old.shape, value.shape)):
            raise SettingsError(f"warm start: {name} is {tuple(old.shape)}, expected at most {tuple(value.shape)}")
        if old.shape != value.shape:
            grown.append(name)
        _copy_leading(old, value)
    return grown


@torch.no_grad()
def adopt(source: nn.Module, target: nn.Module) -> list[str]:
    """Copy every tensor of the same name and shape; returns the names that `target` keeps as built: its own head.

    Raises ValueError when there is nothing in common.
    """
    known, wanted = source.state_dict(), target.state_dict()
    own = []
    for name, value in wanted.items():
        if name in known and known[name].shape == value.shape:
            value.copy_(known[name])
        else:
            own.append(name)
    if len(own) == len(wanted):
        raise SettingsError(f"warm start: nothing in common with the weights given, which have {sorted(known)[:3]} ...")
    return own


@torch.no_grad()
def _copy_leading(old: Tensor, value: Tensor) -> None:
    """`old` into the leading entries of `value`; the old outputs (axis 0) get zeros for every added input."""
    if value.dim() == 0:
        value.copy_(old)
        return
    value[: old.shape[0]] = 0
    value[tuple(slice(0, size) for size in old.shape)] = old
