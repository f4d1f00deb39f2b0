"""Layers that the LiDAR-frame detectors share, indexed as in OpenPCDet's checkpoints."""

from __future__ import annotations

from collections.abc import Sequence

from torch import nn

from detection.models.layers import PointwiseWeight, RowBatchNorm

# OpenPCDet's normalisation in voxel encoders, 3D and 2D backbones; its point networks and heads keep torch's defaults.
EPS, MOMENTUM = 1e-3, 0.01


def hidden_layers(in_channels: int, widths: Sequence[int], axes: int, dropout: float) -> list[nn.Module]:
    """Product, normalisation, ReLU per width on rows (..., C); a Dropout after every one but the last.

    axes  trailing singleton axes of the weights. Two widths give the indices 0 1 2, 3 (Dropout), 4 5 6.
    """
    modules: list[nn.Module] = []
    for k, width in enumerate(widths):
        modules += [PointwiseWeight(in_channels, width, axes, bias=False), RowBatchNorm(width), nn.ReLU()]
        if k + 1 < len(widths) and dropout > 0:
            modules.append(nn.Dropout(dropout))
        in_channels = width
    return modules


def head(in_channels: int, widths: Sequence[int], out_channels: int, axes: int, dropout: float) -> nn.Sequential:
    """`hidden_layers`, then a product with bias: two widths put it at index 7, or 6 without dropout."""
    last = PointwiseWeight(widths[-1], out_channels, axes, bias=True)
    return nn.Sequential(*hidden_layers(in_channels, widths, axes, dropout), last)
