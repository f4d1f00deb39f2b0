"""Batch normalisation fused with ReLU, or with the maximum over neighbours, when training on the CPU.

PyTorch makes six passes over memory for normalisation, ReLU and maximum and their gradients, and stores what lies
between them. In a point network on a CPU these passes cost as much as the matrix products; here they are three.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from detection.ops import _norm_kernels as kernels

# Fixed, so that sums are added in the same order whatever the number of threads.
_BLOCKS = 8
_SMALLEST_BLOCK = 256

Moments = tuple[Tensor, Tensor]


def can_fuse(rows: Tensor) -> bool:
    """Whether the operations below take these rows: float32 on the CPU, more than one."""
    return rows.device.type == "cpu" and rows.dtype == torch.float32 and rows.numel() > rows.shape[-1]


def norm_relu(rows: Tensor, weight: Tensor, bias: Tensor, eps: float) -> tuple[Tensor, Moments]:
    """(..., C) -> relu(weight * (rows - mean) / sqrt(var + eps) + bias), and the batch's (mean, biased variance), (C,).

    Statistics over every axis but the last. The moments carry no gradient; they are for running averages.
    """
    out, mean, variance = _NormRelu.apply(rows, weight, bias, eps)
    return out, (mean, variance)


def norm_relu_maximum(rows: Tensor, weight: Tensor, bias: Tensor, eps: float) -> tuple[Tensor, Moments]:
    """(R, K, C) -> (R, C): the maximum of `norm_relu` over the neighbours K; of equal ones the first gets
    the gradient."""
    out, mean, variance = _NormReluMaximum.apply(rows, weight, bias, eps)
    return out, (mean, variance)


def _blocks(count: int) -> list[tuple[int, int]]:
    parts = max(1, min(_BLOCKS, count // _SMALLEST_BLOCK))
    bounds = [count * part // parts for part in range(parts + 1)]
    return list(pairwise(bounds))


def _on_blocks(work: Callable[[int, int, int], None], count: int) -> None:
    """Calls work(number, start, stop) on every block of `count` rows, in as many threads as torch has."""
    jobs = [(number, *bounds) for number, bounds in enumerate(_blocks(count))]
    threads = min(torch.get_num_threads(), len(jobs))
    if threads == 1:
        for job in jobs:
            work(*job)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda job: work(*job), jobs))


def _partial_sums(work: Callable[..., None], count: int, channels: int) -> NDArray[np.float64]:
    """(2, C): work(start, stop, first, second) adds to two rows of sums, one pair per block."""
    parts = np.zeros((2, len(_blocks(count)), channels))
    _on_blocks(lambda number, start, stop: work(start, stop, parts[0, number], parts[1, number]), count)
    total: NDArray[np.float64] = parts.sum(axis=1)
    return total


def _array(tensor: Tensor) -> NDArray[np.float32]:
    values: NDArray[np.float32] = tensor.detach().contiguous().numpy()
    return values


class _Statistics:
    """Moments of rows (N, C) and the affine map the normalisation amounts to."""

    def __init__(self, rows: NDArray[np.float32], weight: Tensor, bias: Tensor, eps: float) -> None:
        count, channels = rows.shape
        total, squares = _partial_sums(lambda *block: kernels.sums(rows, *block), count, channels)
        mean = total / count
        self.mean, self.variance = mean, np.maximum(squares / count - mean**2, 0.0)
        self.inverse = 1 / np.sqrt(self.variance + eps)
        scale = self.inverse * _array(weight)
        self.scale, self.shift = scale.astype(np.float32), (_array(bias) - mean * scale).astype(np.float32)

    def tensors(self) -> Moments:
        """Mean and variance as float32 tensors."""
        return torch.from_numpy(self.mean.astype(np.float32)), torch.from_numpy(self.variance.astype(np.float32))


def _input_gradient(statistics: _Statistics, sums: NDArray[np.float64], count: int) -> tuple[Any, Any, Tensor, Tensor]:
    """(slope, offset) of the part of the gradient that goes through the moments, and gradients of weight and bias.

    d rows = scale * (g - mean(g) - xhat * mean(g xhat)), written as g * scale + rows * slope + offset.
    """
    total, products = sums
    of_weight = products * statistics.inverse
    scale = statistics.scale.astype(np.float64)
    slope = -scale * of_weight * statistics.inverse / count
    offset = -scale * total / count - slope * statistics.mean
    gradients = (torch.from_numpy(values.astype(np.float32)) for values in (of_weight, total))
    return slope.astype(np.float32), offset.astype(np.float32), *gradients


class _NormRelu(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor, eps: float) -> tuple[Tensor, Tensor, Tensor]:
        flat = _array(rows.reshape(-1, rows.shape[-1]))
        statistics = _Statistics(flat, weight, bias, eps)
        out = np.empty_like(flat)
        scale, shift = statistics.scale, statistics.shift
        _on_blocks(lambda _, start, stop: kernels.relu_forward(flat, scale, shift, start, stop, out), len(flat))
        result = torch.from_numpy(out).view(rows.shape)
        ctx.save_for_backward(rows, result)
        ctx.statistics = statistics
        moments = statistics.tensors()
        ctx.mark_non_differentiable(*moments)
        return result, *moments

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, *_: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        rows, out = ctx.saved_tensors
        flat, passed, grads = (_array(value.reshape(-1, rows.shape[-1])) for value in (rows, out, grad))
        found, count = ctx.statistics, len(flat)
        sums = _partial_sums(
            lambda *block: kernels.relu_sums(flat, found.mean, passed, grads, *block), count, flat.shape[1]
        )
        slope, offset, of_weight, of_bias = _input_gradient(found, sums, count)
        result = np.empty_like(flat)
        _on_blocks(
            lambda _, start, stop: kernels.relu_backward(
                flat, passed, grads, found.scale, slope, offset, start, stop, result
            ),
            count,
        )
        return torch.from_numpy(result).view(rows.shape), of_weight, of_bias, None


class _NormReluMaximum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor, eps: float) -> tuple[Tensor, Tensor, Tensor]:
        groups, _, channels = rows.shape
        values = _array(rows)
        statistics = _Statistics(values.reshape(-1, channels), weight, bias, eps)
        out = np.empty((groups, channels), dtype=np.float32)
        chosen = np.empty((groups, channels), dtype=np.int32)
        scale, shift = statistics.scale, statistics.shift
        _on_blocks(
            lambda _, start, stop: kernels.maximum_forward(values, scale, shift, start, stop, out, chosen), groups
        )
        result = torch.from_numpy(out)
        ctx.save_for_backward(rows, result)
        ctx.statistics, ctx.chosen = statistics, chosen
        moments = statistics.tensors()
        ctx.mark_non_differentiable(*moments)
        return result, *moments

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, *_: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        rows, out = ctx.saved_tensors
        values, passed, grads, chosen = _array(rows), _array(out), _array(grad), ctx.chosen
        found, (groups, neighbours, channels) = ctx.statistics, values.shape
        sums = _partial_sums(
            lambda *block: kernels.maximum_sums(values, found.mean, passed, chosen, grads, *block), groups, channels
        )
        slope, offset, of_weight, of_bias = _input_gradient(found, sums, groups * neighbours)
        result = np.empty_like(values)
        _on_blocks(
            lambda _, start, stop: kernels.maximum_backward(
                values, passed, chosen, grads, found.scale, slope, offset, start, stop, result
            ),
            groups,
        )
        return torch.from_numpy(result), of_weight, of_bias, None
