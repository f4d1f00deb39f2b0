"""Reading the public detector checkpoints without running anything in them.

They are pickles; `auglidar_base.torch_pickle` reads them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from auglidar_base.errors import CheckpointError
from auglidar_base.torch_pickle import read_torch_pickle
from detection.models.lidar_presets import OPENPCDET_PRESETS, openpcdet_features
from detection.models.openpcdet_pointrcnn import OpenPCDetPointRCNN
from detection.models.presets import pointrcnn, pointrcnn2


def read_tensors(path: str | Path) -> dict[str, Tensor]:
    """The tensors of `model_state`, `state_dict` and the like or a bare state dict; `module.` in front is taken off."""
    content = read_torch_pickle(path)
    if isinstance(content, Mapping):
        for key in ("model_state", "state_dict", "model", "model_state_dict"):
            if isinstance(content.get(key), Mapping):
                content = content[key]
                break
        tensors = {str(k).removeprefix("module."): v for k, v in content.items() if isinstance(v, Tensor)}
        if tensors:
            return tensors
    raise CheckpointError(
        f"{path}: expected a dictionary with 'model_state' or a state dict of tensors, found no tensor"
    )


@dataclass(frozen=True)
class ImportReport:
    """What an import did with the file's tensors.

    consumed  names that were loaded, each once       counters  num_batches_tracked the file lacks, left at zero
    unused    names in the file that the network does not have
    """

    consumed: tuple[str, ...]
    counters: tuple[str, ...]
    unused: tuple[str, ...]


def fill(model: nn.Module, tensors: Mapping[str, Tensor], where: str | Path) -> ImportReport:
    """Load tensors by name; every parameter and running statistic must be there with its shape.

    Shapes may differ by trailing axes of length 1 (Linear, Conv1d, Conv2d). CheckpointError lists every name that
    is missing, unknown or misshapen.
    """
    own = model.state_dict()
    wrong: list[str] = []
    loaded: dict[str, Tensor] = {}
    counters = tuple(n for n in own if n not in tensors and n.endswith(("num_batches_tracked", "global_step")))
    for name, value in own.items():
        if name in counters:
            loaded[name] = value
        elif name not in tensors:
            wrong.append(f"missing {name}")
        elif _squeezed(tensors[name].shape) != _squeezed(value.shape):
            wrong.append(f"{name} is {tuple(tensors[name].shape)}, expected {tuple(value.shape)}")
        else:
            loaded[name] = tensors[name].reshape(value.shape)
    unused = tuple(name for name in tensors if name not in own)
    wrong += [f"unknown {name}" for name in unused]
    if wrong:
        more = f"; and {len(wrong) - 8} more" if len(wrong) > 8 else ""
        raise CheckpointError(
            f"{where}: does not fit this network ({len(own)} tensors): " + "; ".join(wrong[:8]) + more
        )
    model.load_state_dict(loaded)
    return ImportReport(tuple(name for name in own if name in tensors), counters, unused)


def _squeezed(shape: torch.Size) -> tuple[int, ...]:
    sizes = list(shape)
    while len(sizes) > 1 and sizes[-1] == 1:
        sizes.pop()
    return tuple(sizes)


def _extra_channels(tensors: Mapping[str, Tensor]) -> tuple[str, ...]:
    """Point features for the input channels beyond x y z; the public code has one slot, for the intensity."""
    first = tensors.get("rpn.backbone_net.SA_modules.0.mlps.0.layer0.conv.weight")
    extra = 0 if first is None else int(first.shape[1]) - 3
    if extra not in (0, 1):
        raise CheckpointError(f"expected 3 or 4 input channels (x y z, intensity), the checkpoint has {extra + 3}")
    return ("intensity",) * extra


def _pointrcnn(tensors: Mapping[str, Tensor]) -> nn.Module:
    heads = tensors.get("rpn.rpn_reg_layer.2.conv.weight")
    return pointrcnn(
        fine_location=heads is not None and heads.shape[0] == 76, features=_extra_channels(tensors)
    ).build()


def _epnet(tensors: Mapping[str, Tensor]) -> nn.Module:
    fused = sorted({name.split(".")[2] for name in tensors if re.search(r"\.(Img_Block|Fusion_Conv|DeConv)\.", name)})
    if fused:
        raise CheckpointError(
            f"this EPNet checkpoint was trained with image fusion (it holds {', '.join(fused)}); its point layers "
            "expect fused features, so it cannot run on points alone; take the one trained without LI-Fusion"
        )
    branch = any(name.startswith("rcnn_net.iou_branch.") for name in tensors)
    return pointrcnn2(features=_extra_channels(tensors), iou_branch=branch).build()


def _openpcdet_pointrcnn(tensors: Mapping[str, Tensor]) -> nn.Module:
    return OpenPCDetPointRCNN()


def _openpcdet(architecture: str) -> Callable[[Mapping[str, Tensor]], nn.Module]:
    """The voxel detector with as many classes and point columns as the checkpoint's heads and first layer show."""

    def build(tensors: Mapping[str, Tensor]) -> nn.Module:
        scores = tensors.get("dense_head.conv_cls.weight")
        # Anchors per cell (2 per class) times classes.
        count = 3 if scores is None else round((scores.shape[0] / 2) ** 0.5)
        classes = ("Car", "Pedestrian", "Cyclist")[:count]
        return OPENPCDET_PRESETS[architecture](openpcdet_features(_point_channels(tensors)), classes).build()

    return build


def _point_channels(tensors: Mapping[str, Tensor]) -> int:
    """Point channels of a voxel detector: pillars add six of their own, spconv's layouts differ in where they stand."""
    pillars = tensors.get("vfe.pfn_layers.0.linear.weight")
    if pillars is not None:
        return int(pillars.shape[1]) - 6
    first = tensors.get("backbone_3d.conv_input.0.weight")
    if first is None or first.dim() != 5:
        return 4
    return int(first.shape[3] if first.shape[:3] == (3, 3, 3) else first.shape[4])


def to_spconv2(tensors: Mapping[str, Tensor], model: nn.Module) -> dict[str, Tensor]:
    """Sparse weights of spconv 1.x (kz, ky, kx, in, out) in 2.x's layout (out, kz, ky, kx, in), told apart by shape."""
    own, found = model.state_dict(), dict(tensors)
    for name, value in tensors.items():
        if value.dim() == 5 and name in own and value.shape != own[name].shape:
            found[name] = value.permute(4, 0, 1, 2, 3)
    return found


# Architecture -> the network that fits a checkpoint's shapes.
BUILDERS: dict[str, Callable[[Mapping[str, Tensor]], nn.Module]] = {
    "pointrcnn": _pointrcnn,
    "epnet": _epnet,
    "openpcdet_pointrcnn": _openpcdet_pointrcnn,
    **{architecture: _openpcdet(architecture) for architecture in OPENPCDET_PRESETS},
}


def import_with_report(path: str | Path, architecture: str) -> tuple[nn.Module, ImportReport]:
    """`import_checkpoint`, and what became of every tensor."""
    if architecture not in BUILDERS:
        raise CheckpointError(f"unknown architecture {architecture!r}; known are {', '.join(BUILDERS)}")
    tensors = read_tensors(path)
    try:
        return _filled(tensors, architecture, path)
    except CheckpointError as error:
        others = [name for name in BUILDERS if name != architecture and _fits(tensors, name)]
        raise CheckpointError(f"{error}; it fits {' or '.join(others)}" if others else str(error)) from None


def _filled(tensors: Mapping[str, Tensor], architecture: str, path: str | Path) -> tuple[nn.Module, ImportReport]:
    try:
        model = BUILDERS[architecture](tensors)
    except ValueError as error:
        raise CheckpointError(f"{path}: {error}") from error
    return model.eval(), fill(model, to_spconv2(tensors, model), path)


def _fits(tensors: Mapping[str, Tensor], architecture: str) -> bool:
    try:
        _filled(tensors, architecture, architecture)
    except CheckpointError:
        return False
    return True


def import_checkpoint(path: str | Path, architecture: str) -> nn.Module:
    """A network in eval mode filled with a public checkpoint.

    architecture  "pointrcnn" (52 or 76 first-stage channels, told apart by shape), "epnet" (fusion off),
                  "openpcdet_pointrcnn", and OpenPCDet's "pointpillar", "second", "voxel_rcnn", "pv_rcnn"
    Raises CheckpointError when the file calls functions, is damaged, or does not fit; nothing in it is executed.
    """
    return import_with_report(path, architecture)[0]
