"""Residual blocks."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F

from completion.models.resnet import BasicBlock


def _strided(block: BasicBlock, x: torch.Tensor) -> torch.Tensor:
    """What the block is defined as: its shortcut is one strided 1x1 convolution."""
    assert isinstance(block.downsample, nn.Sequential)
    convolution, norm = block.downsample
    assert isinstance(convolution, nn.Conv2d)
    identity = norm(F.conv2d(x, convolution.weight, stride=2))
    y = F.relu(block.bn1(block.conv1(x)))
    return F.relu(block.bn2(block.conv2(y)) + identity)


def test_a_strided_block_has_the_values_and_gradients_of_a_strided_shortcut() -> None:
    torch.manual_seed(0)
    block = BasicBlock(3, 5, 2).double().eval()
    x = torch.randn(2, 3, 9, 12, dtype=torch.float64, requires_grad=True)
    for wanted, found in zip(_both(_strided(block, x), block, x), _both(block(x), block, x), strict=True):
        torch.testing.assert_close(found, wanted)


def _both(y: torch.Tensor, block: BasicBlock, x: torch.Tensor) -> list[torch.Tensor]:
    variables = [x, *block.parameters()]
    return [y, *torch.autograd.grad(y.square().sum(), variables)]


def test_eight_channels_that_lie_last_can_be_trained() -> None:
    # With a strided 1x1 convolution torch 2.13 corrupts the heap here, within a few steps.
    torch.manual_seed(0)
    block = BasicBlock(8, 16, 2).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    for _ in range(10):
        x = torch.rand(1, 8, 96, 192).to(memory_format=torch.channels_last)
        block(x).square().mean().backward()
    assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in block.parameters())
