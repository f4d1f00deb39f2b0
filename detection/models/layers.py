"""Point-wise layers on channel-last rows (..., C), with the parameter names of the public PointRCNN checkpoints.

A 1x1 convolution over points is a matrix product on rows. Keeping rows contiguous makes it one product, makes gathering
a neighbour one copy, and lets batch normalisation use the channels-last kernels (half the time of the planar ones on a
CPU). Weights keep the checkpoints' trailing singleton axes, (out, in, 1) or (out, in, 1, 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class PointwiseWeight(nn.Module):
    """The parameters of a 1x1 convolution: weight (out, in, 1[, 1]) and perhaps bias (out,)."""

    def __init__(self, in_channels: int, out_channels: int, axes: int, bias: bool) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, *([1] * axes)))
        self.bias = nn.Parameter(torch.zeros(out_channels)) if bias else None
        nn.init.kaiming_normal_(self.weight)

    @property
    def matrix(self) -> Tensor:
        """(out, in) view of the weight."""
        return self.weight.flatten(1)

    def forward(self, rows: Tensor) -> Tensor:
        """(..., in) -> (..., out)."""
        return F.linear(rows, self.matrix, self.bias)


class RowBatchNorm(nn.BatchNorm1d):
    """Batch normalisation of rows (..., C): statistics over every axis but the last."""

    def forward(self, rows: Tensor) -> Tensor:
        """(..., C) -> (..., C)."""
        if not self.training:
            scale, shift = self.as_affine()
            return torch.addcmul(shift, rows, scale)
        if self.num_batches_tracked is not None:
            self.num_batches_tracked.add_(1)
        # As a (1, C, rows, 1) image in channels-last order, so that no transposition is needed.
        image = rows.reshape(1, -1, 1, rows.shape[-1]).permute(0, 3, 1, 2)
        normalised = F.batch_norm(
            image,
            self.running_mean,
            self.running_var,
            self.weight,
            self.bias,
            True,
            cast(float, self.momentum),
            self.eps,
        )
        return normalised.permute(0, 2, 3, 1).reshape(rows.shape)

    def as_affine(self) -> tuple[Tensor, Tensor]:
        """(scale, shift), each (C,), of the normalisation with the running statistics."""
        scale = self.weight * torch.rsqrt(cast(Tensor, self.running_var) + self.eps)
        return scale, self.bias - cast(Tensor, self.running_mean) * scale


class NamedBatchNorm(nn.Module):
    """A batch normalisation under the name `bn`, as the checkpoints' `layer0.bn.bn.weight` asks for."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.bn = RowBatchNorm(channels)

    def forward(self, rows: Tensor) -> Tensor:
        """(..., C) -> (..., C)."""
        return cast(Tensor, self.bn(rows))


class PointLayer(nn.Module):
    """1x1 convolution, batch normalisation (then without bias), ReLU.

    axes  trailing singleton axes of the weight: 1 (Conv1d) or 2 (Conv2d)
    """

    def __init__(
        self, in_channels: int, out_channels: int, axes: int = 2, norm: bool = True, activation: bool = True
    ) -> None:
        super().__init__()
        self.conv = PointwiseWeight(in_channels, out_channels, axes, bias=not norm)
        self.bn = NamedBatchNorm(out_channels) if norm else None
        self.activation = activation

    def project(self, rows: Tensor, offset: Tensor | None = None) -> Tensor:
        """Convolution and normalisation before the ReLU, (..., in) -> (..., out).

        offset  (3,)-columns form of the input: (..., 3) relative coordinates whose product with the first three weight
                columns is added to `rows`, which then already holds the product of the others (see `source_product`)
        """
        if offset is not None:
            projected = rows + F.linear(offset, self.conv.matrix[:, :3], self.conv.bias)
            return projected if self.bn is None else cast(Tensor, self.bn(projected))
        if self.bn is not None and not self.training:
            scale, shift = self.bn.bn.as_affine()
            return F.linear(rows, self.conv.matrix * scale[:, None], shift)
        projected = self.conv(rows)
        return projected if self.bn is None else cast(Tensor, self.bn(projected))

    def source_product(self, features: Tensor) -> Tensor:
        """(..., in - 3) features -> (..., out): their share of the product, computed once per source point.

        W [x_j - c, f_j] = W_x (x_j - c) + W_f f_j, and W_f f_j does not depend on the group that gathers point j.
        """
        return F.linear(features, self.conv.matrix[:, 3:])

    def forward(self, rows: Tensor) -> Tensor:
        """(..., in) -> (..., out)."""
        projected = self.project(rows)
        return F.relu(projected, inplace=True) if self.activation else projected


class SharedMLP(nn.Sequential):
    """PointLayers named layer0, layer1, ... applied to every point alike."""

    def __init__(self, channels: Sequence[int], norm: bool = True) -> None:
        super().__init__()
        for k, (in_channels, out_channels) in enumerate(pairwise(channels)):
            self.add_module(f"layer{k}", PointLayer(in_channels, out_channels, norm=norm))

    def group_maximum(self, source: Tensor | None, offset: Tensor, gather: Tensor) -> Tensor:
        """The point network of one group level: (R, K) groups -> (R, out).

        source  (S, C) features of all source points, or None when coordinates are all there is
        offset  (R, K, 3) coordinates of the neighbours relative to their centre, metres
        gather  (R, K) int64 row of each neighbour in `source`
        """
        layers = cast("list[PointLayer]", list(self))
        first = layers[0]
        if source is None:
            rows = first.project(offset)
        else:
            shared = first.source_product(source)
            rows = first.project(shared.index_select(0, gather.reshape(-1)).view(*gather.shape, -1), offset)
        for layer in layers[1:]:
            rows = layer.project(F.relu(rows, inplace=True))
        # max(relu(x)) = relu(max(x)); the maximum first saves a pass over all neighbours.
        return F.relu(rows.max(dim=-2).values, inplace=True)


def prediction_head(
    in_channels: int, hidden: Sequence[int], out_channels: int, norm: bool, dropout: float
) -> nn.Sequential:
    """Conv1d head with a Dropout at Sequential index 1, where the public checkpoints have it.

    One hidden layer gives the indices 0 and 2 (RPN), two give 0, 2 and 3 (RCNN).
    """
    layers: list[nn.Module] = []
    channels = in_channels
    for width in hidden:
        layers.append(PointLayer(channels, width, axes=1, norm=norm))
        channels = width
    layers.append(PointLayer(channels, out_channels, axes=1, norm=False, activation=False))
    layers.insert(1, nn.Dropout(dropout))
    return nn.Sequential(*layers)


def set_batchnorm_momentum(model: nn.Module, momentum: float) -> None:
    """Give every batch normalisation of the model this momentum (PointRCNN's schedule changes it during training)."""
    for module in model.modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            module.momentum = momentum
