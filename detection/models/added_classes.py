"""Starting a compact detector with more classes from one with fewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from auglidar_base.errors import SettingsError
from detection.inputs import SIMILAR
from detection.models.compact import CompactPointRCNN


def with_classes(source: nn.Module, classes: Sequence[str]) -> nn.Module:
    """`source` for these classes: a class it lacks starts as a copy of the one it counts as (`SIMILAR`: Van as Car).

    Networks other than the compact one, and those that have just these classes, are returned as they are.
    Raises SettingsError for a class that neither the network nor its similar class knows.
    """
    if not isinstance(source, CompactPointRCNN) or source.settings.classes == tuple(classes):
        return source
    known = source.settings.classes
    origin = [name if name in known else SIMILAR.get(name, name) for name in classes]
    unknown = [name for name in origin if name not in known]
    if unknown:
        raise SettingsError(f"warm start: the weights know {', '.join(known)}, nothing to start {unknown[0]} from")
    index = torch.tensor([known.index(name) for name in origin])
    target = CompactPointRCNN(replace(source.settings, classes=tuple(classes)))
    state = source.state_dict()
    for name in ("weight", "bias"):
        key = f"points.class_scores.conv.{name}"
        state[key] = state[key][index]
    key = "regions.region.conv.weight"
    state[key] = _columns_for(state[key], source.points.backbone.out_channels, len(known), index)
    target.load_state_dict(state)
    return target


def _columns_for(weight: Tensor, first: int, count: int, index: Tensor) -> Tensor:
    """The weight (out, in, 1) with its `count` columns from `first`, one per class, chosen anew by `index`."""
    before, of_class, behind = weight.split([first, count, weight.shape[1] - first - count], dim=1)
    return torch.cat([before, of_class[:, index], behind], dim=1)
