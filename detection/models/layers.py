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

from detection.ops.norm import can_fuse, norm_relu, norm_relu_maximum


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

    def relu(self, rows: Tensor) -> Tensor:
        """relu(self(rows)), (..., C) -> (..., C); in one operation when training on a CPU."""
        if not (self.training and can_fuse(rows)):
            return F.relu(self(rows), inplace=True)
        out, moments = norm_relu(rows, self.weight, self.bias, self.eps)
        self._track(moments, rows.numel() // rows.shape[-1])
        return out

    def relu_maximum(self, rows: Tensor) -> Tensor:
        """relu(self(rows)) and its maximum over the neighbours, (R, K, C) -> (R, C)."""
        if not (self.training and can_fuse(rows)):
            # max(relu(x)) = relu(max(x)); the maximum first saves a pass over all neighbours.
            return F.relu(maximum(self(rows)), inplace=True)
        out, moments = norm_relu_maximum(rows, self.weight, self.bias, self.eps)
        self._track(moments, rows.numel() // rows.shape[-1])
        return out

    @torch.no_grad()
    def _track(self, moments: tuple[Tensor, Tensor], count: int) -> None:
        """Moves the running statistics as `F.batch_norm` does, with the unbiased variance of `count` rows."""
        mean, variance = moments
        momentum = cast(float, self.momentum)
        cast(Tensor, self.num_batches_tracked).add_(1)
        cast(Tensor, self.running_mean).lerp_(mean, momentum)
        cast(Tensor, self.running_var).lerp_(variance * (count / (count - 1)), momentum)

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


def project(conv: PointwiseWeight, norm: nn.Module | None, rows: Tensor) -> Tensor:
    """Convolution and normalisation, (..., in) -> (..., out); one product when the statistics are fixed."""
    if norm is None or norm.training:
        projected: Tensor = conv(rows)
        return projected if norm is None else cast(Tensor, norm(projected))
    scale, shift = _batch_norm(norm).as_affine()
    if conv.bias is not None:
        shift = torch.addcmul(shift, conv.bias, scale)
    return F.linear(rows, conv.matrix * scale[:, None], shift)


def begin(conv: PointwiseWeight, norm: nn.Module | None, rows: Tensor) -> tuple[Tensor, nn.Module | None]:
    """The convolution, and the normalisation that is still to follow: none when its statistics are fixed."""
    if norm is not None and norm.training:
        return conv(rows), norm
    return project(conv, norm, rows), None


def project_relu(conv: PointwiseWeight, norm: nn.Module | None, rows: Tensor) -> Tensor:
    """`project` and ReLU."""
    if norm is None or not norm.training:
        return F.relu(project(conv, norm, rows), inplace=True)
    return _batch_norm(norm).relu(conv(rows))


def normalise_relu(norm: nn.Module | None, rows: Tensor) -> Tensor:
    """Normalisation (or none) and ReLU."""
    return F.relu(rows, inplace=True) if norm is None else _batch_norm(norm).relu(rows)


def normalise_relu_maximum(norm: nn.Module | None, rows: Tensor) -> Tensor:
    """Normalisation (or none) and ReLU of groups (R, K, C), and their maximum (R, C)."""
    if norm is None:
        # max(relu(x)) = relu(max(x)); the maximum first saves a pass over all neighbours.
        return F.relu(maximum(rows), inplace=True)
    return _batch_norm(norm).relu_maximum(rows)


def _batch_norm(norm: nn.Module) -> RowBatchNorm:
    return cast(RowBatchNorm, norm.bn if isinstance(norm, NamedBatchNorm) else norm)


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

    def forward(self, rows: Tensor) -> Tensor:
        """(..., in) -> (..., out)."""
        return project_relu(self.conv, self.bn, rows) if self.activation else project(self.conv, self.bn, rows)


_CACHED_ROWS = 4096


class PointMLP(nn.Sequential):
    """Convolution, normalisation (or none) and ReLU, several times, on every point alike."""

    def stages(self) -> list[tuple[PointwiseWeight, nn.Module | None]]:
        """The convolutions with their normalisations, in order."""
        convolutions = [module for module in self.modules() if isinstance(module, PointwiseWeight)]
        norms: list[nn.Module | None] = [module for module in self.modules() if isinstance(module, RowBatchNorm)]
        return list(zip(convolutions, norms or [None] * len(convolutions)))

    def forward(self, rows: Tensor) -> Tensor:
        """(..., in) -> (..., out)."""
        for conv, norm in self.stages():
            rows = project_relu(conv, norm, rows)
        return rows

    def group_maximum(self, source: Tensor | None, offset: Tensor, gather: Tensor) -> Tensor:
        """The point network of one group level: (R, K) groups -> (R, out).

        source  (S, C) features of all source points, or None when coordinates are all there is
        offset  (R, K, 3) coordinates of the neighbours relative to their centre, metres
        gather  (R, K) int64 row of each neighbour in `source`
        """
        # W [x_j - c, f_j] = W_x (x_j - c) + W_f f_j: the second product does not depend on the group that gathers
        # point j, so it is taken once per source point.
        shared = None if source is None else F.linear(source, self.stages()[0][0].matrix[:, 3:])
        if self.training or torch.is_grad_enabled():
            return self._maximum(shared, offset, gather)
        # Without gradients a few groups at a time, so that what passes between layers stays in the cache.
        groups = max(1, _CACHED_ROWS // offset.shape[1])
        parts = zip(offset.split(groups), gather.split(groups))
        return torch.cat([self._maximum(shared, some_offset, some) for some_offset, some in parts])

    def _maximum(self, shared: Tensor | None, offset: Tensor, gather: Tensor) -> Tensor:
        """`group_maximum` with the product of the source features already taken."""
        (conv, norm), *others = self.stages()
        if shared is None:
            rows, norm = begin(conv, norm, offset)
        else:
            rows = shared.index_select(0, gather.reshape(-1)).view(*gather.shape, -1)
            rows = rows + F.linear(offset, conv.matrix[:, :3], conv.bias)
        for conv, following in others:
            rows, norm = begin(conv, following, normalise_relu(norm, rows))
        return normalise_relu_maximum(norm, rows)


def maximum(rows: Tensor) -> Tensor:
    """(..., K, C) -> (..., C), the largest of each channel; with gradients, of equal ones only the first gets any."""
    # amax does not keep indices: much faster forward (16 times for 64 x 128), but twice as slow with its backward pass.
    return rows.max(dim=-2).values if torch.is_grad_enabled() else rows.amax(dim=-2)


class SharedMLP(PointMLP):
    """Layers named layer0, layer1, ..., as in the checkpoints of PointRCNN and EPNet."""

    def __init__(self, channels: Sequence[int], norm: bool = True) -> None:
        super().__init__()
        for k, (in_channels, out_channels) in enumerate(pairwise(channels)):
            self.add_module(f"layer{k}", PointLayer(in_channels, out_channels, norm=norm))


class IndexedMLP(PointMLP):
    """Convolution, normalisation and ReLU at consecutive indices (0, 1, 2, 3, ...), as in OpenPCDet's checkpoints."""

    def __init__(self, channels: Sequence[int], norm: bool = True) -> None:
        modules: list[nn.Module] = []
        for in_channels, out_channels in pairwise(channels):
            modules.append(PointwiseWeight(in_channels, out_channels, 2, bias=not norm))
            modules += [RowBatchNorm(out_channels)] * norm
            modules.append(nn.ReLU())
        super().__init__(*modules)


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
