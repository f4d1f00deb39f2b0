"""Starting a network from one with fewer input channels, or a two-stage one from its first stage."""

from __future__ import annotations

import torch
from torch import nn

from auglidar_base.errors import SettingsError

# Input columns that stand behind the extra ones: a pillar's offsets to its mean and to its centre.
_BEHIND = {"vfe.pfn_layers.0.linear.weight": 6}


def copy_matching(source: nn.Module, target: nn.Module) -> list[str]:
    """Copy every weight; where `target` has more input columns, the new ones start at zero, so it computes the same.

    Whole modules that only `target` has keep their weights: SECOND's are the first stage of Voxel-RCNN and PV-RCNN.
    Extra point channels are the last columns of the first set abstraction (x y z, extra) and of the last feature
    propagation (interpolated, skip); voxel encoders have them behind the point's others.
    Returns the names that were widened.
    Raises SettingsError when names differ or a shape differs in another way.
    """
    old, new = source.state_dict(), target.state_dict()
    modules = {name.partition(".")[0] for name in old}
    differing = old.keys() - new.keys() | {
        name for name in new.keys() - old.keys() if name.partition(".")[0] in modules
    }
    if differing:
        raise SettingsError(f"warm start: the networks differ in {sorted(differing)[:5]}")
    widened = []
    for name, known in old.items():
        value = new[name]
        if known.shape == value.shape:
            value.copy_(known)
            continue
        axis = _widened_axis(known.shape, value.shape)
        if axis is None:
            raise SettingsError(
                f"warm start: {name} is {tuple(known.shape)}, expected {tuple(value.shape)} or fewer columns"
            )
        behind = _BEHIND.get(name, 0)
        front, last = known.shape[axis] - behind, value.shape[axis] - behind
        with torch.no_grad():
            value.zero_()
            value.narrow(axis, 0, front).copy_(known.narrow(axis, 0, front))
            value.narrow(axis, last, behind).copy_(known.narrow(axis, front, behind))
        widened.append(name)
    return widened


def _widened_axis(known: torch.Size, wanted: torch.Size) -> int | None:
    """The input axis along which alone `wanted` is longer: 1, or the last one of a sparse convolution's weight."""
    axis = 4 if len(wanted) == 5 else 1
    if not len(known) == len(wanted) > axis or known[axis] > wanted[axis]:
        return None
    same = [known[k] == wanted[k] for k in range(len(wanted)) if k != axis]
    return axis if all(same) else None
