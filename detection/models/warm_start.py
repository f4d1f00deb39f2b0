"""Starting a network with more input channels from one with fewer."""

from __future__ import annotations

import torch
from torch import nn


def copy_matching(source: nn.Module, target: nn.Module) -> list[str]:
    """Copy every weight; where `target` has more input columns, the new ones start at zero, so it computes the same.

    Extra point channels are the last columns of the first set abstraction (x y z, extra) and of the last feature
    propagation (interpolated, skip). Returns the names that were widened.
    Raises ValueError when names differ or a shape differs in another way.
    """
    old, new = source.state_dict(), target.state_dict()
    if old.keys() != new.keys():
        raise ValueError(f"warm start: the networks differ in {sorted(old.keys() ^ new.keys())[:5]}")
    widened = []
    for name, value in new.items():
        known = old[name]
        if known.shape == value.shape:
            value.copy_(known)
            continue
        same_rest = (
            known.dim() == value.dim() > 1 and known.shape[0] == value.shape[0] and known.shape[2:] == value.shape[2:]
        )
        if not same_rest or known.shape[1] > value.shape[1]:
            raise ValueError(
                f"warm start: {name} is {tuple(known.shape)}, expected {tuple(value.shape)} or fewer columns"
            )
        with torch.no_grad():
            value.zero_()
            value[:, : known.shape[1]].copy_(known)
        widened.append(name)
    return widened
