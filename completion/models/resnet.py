"""ResNet basic blocks (He et al., CVPR 2016) with the layer names of torchvision's state dictionaries."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional as F

# Basic blocks of the four layers.
BLOCKS = {18: (2, 2, 2, 2), 34: (3, 4, 6, 3)}


def conv3(inputs: int, outputs: int, stride: int = 1) -> nn.Conv2d:
    """3x3 convolution, padding 1, no bias."""
    return nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, bias=False)


class _Pointwise(nn.Conv2d):
    """A 1x1 convolution that drops the pixels between its strides first, which gives the same numbers.

    torch 2.13's CPU kernel for the gradient of a strided 1x1 convolution writes beyond its memory when it has 8 input
    channels that lie last (the process dies with a corrupted heap); the kernel without stride does not.
    """

    def forward(self, input: Tensor) -> Tensor:
        step_y, step_x = self.stride
        return F.conv2d(input[..., ::step_y, ::step_x], self.weight, self.bias)


class BasicBlock(nn.Module):
    """conv, BN, ReLU, conv, BN, plus the input (through a strided 1x1 convolution where the shape changes), ReLU."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = conv3(inputs, outputs, stride), nn.BatchNorm2d(outputs)
        self.conv2, self.bn2 = conv3(outputs, outputs), nn.BatchNorm2d(outputs)
        self.downsample: nn.Module | None = None
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(_Pointwise(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:
        identity = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(x)) + identity)


def resnet_layer(inputs: int, outputs: int, blocks: int, stride: int) -> nn.Sequential:
    """`blocks` basic blocks, the first with the stride."""
    return nn.Sequential(
        BasicBlock(inputs, outputs, stride), *(BasicBlock(outputs, outputs, 1) for _ in range(blocks - 1))
    )


def block_counts(depth: int) -> tuple[int, int, int, int]:
    """Basic blocks of the four layers of ResNet-`depth`. ValueError unless 18 or 34."""
    if depth not in BLOCKS:
        raise ValueError(f"depth: expected 18 or 34 (ResNet), got {depth}")
    return BLOCKS[depth]
