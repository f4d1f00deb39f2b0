"""Sparse 3D convolution on active voxels (Graham 2015; submanifold: Graham and van der Maaten 2017; SECOND, Yan 2018).

A convolution is a list of pairs (input row, output row) per kernel tap, its rulebook: gather the input rows of a tap,
multiply by its matrix, add to the output rows. Rulebooks depend on the active sites alone and are kept with them, so
that every layer on the same sites shares one. Numba finds the pairs on the CPU, torch elsewhere; both give the same.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detection.ops import _sparse_torch

Triple = tuple[int, int, int]


@dataclass(frozen=True)
class Rulebook:
    """The pairs of a convolution.

    source, target  (P,) int64 rows; pairs of tap k are at starts[k] : starts[k + 1], no target twice within a tap
    sources, targets  how many input and output rows there are
    identity        the tap that joins every row with itself (submanifold: the centre, its pairs are left out), or None
    """

    source: Tensor
    target: Tensor
    starts: tuple[int, ...]
    sources: int
    targets: int
    identity: int | None

    def taps(self) -> list[tuple[int, Tensor, Tensor]]:
        """(tap, sources, targets) of every tap with pairs."""
        spans = enumerate(itertools.pairwise(self.starts))
        return [(k, self.source[i:j], self.target[i:j]) for k, (i, j) in spans if j > i]


@dataclass(frozen=True)
class Sites:
    """The active voxels of a batch.

    coords  (N, 4) int64 b z y x, each once
    shape   (Z, Y, X) of the grid        batch  number of frames
    """

    coords: Tensor
    shape: Triple
    batch: int
    _shared: dict[Any, Any] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.coords.ndim != 2 or self.coords.shape[1] != 4 or self.coords.dtype != torch.int64:
            raise ValueError(
                f"sites: expected (N, 4) int64 b z y x, got {self.coords.dtype} of shape {tuple(self.coords.shape)}"
            )

    def __len__(self) -> int:
        return len(self.coords)

    def table(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Hash table of the sites (CPU), built once."""
        if "table" not in self._shared:
            from detection.ops import _sparse_kernels

            keys, rows = _empty_table(len(self))
            _sparse_kernels.fill_table(_sparse_torch.linear_keys(self.coords, self.shape).numpy(), keys, rows)
            self._shared["table"] = keys, rows
        keys, rows = self._shared["table"]
        return keys, rows

    def submanifold(self, kernel: Triple) -> Rulebook:
        """Rulebook of a convolution whose outputs are these very sites, built once per kernel size (odd numbers)."""
        if any(k % 2 == 0 for k in kernel):
            raise ValueError(f"submanifold convolution: expected odd kernel sizes, got {kernel}")
        if kernel not in self._shared:
            self._shared[kernel] = _submanifold_rulebook(self, kernel)
        found: Rulebook = self._shared[kernel]
        return found

    def strided(self, kernel: Triple, stride: Triple, padding: Triple) -> tuple[Sites, Rulebook]:
        """Sites of the output (ascending b, z, y, x) and rulebook: active is whose window holds an active input."""
        name = (kernel, stride, padding)
        if name not in self._shared:
            self._shared[name] = _strided_rulebook(self, kernel, stride, padding)
        sites, book = self._shared[name]
        return sites, book

    def to_dense(self, features: Tensor) -> Tensor:
        """(N, C) features -> (B, C, Z, Y, X), zero elsewhere; differentiable."""
        frame = self.coords[:, 0]
        cell = _sparse_torch.linear_keys(self.coords, self.shape) - frame * math.prod(self.shape)
        # Few rows are written straight to their planes; a row-wise grid would have to be transposed as a whole.
        dense = features.new_zeros(self.batch, features.shape[1], math.prod(self.shape))
        dense[frame, :, cell] = features
        return dense.view(self.batch, -1, *self.shape)


def _empty_table(entries: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    size = 1 << max(4, int(2 * entries - 1).bit_length())
    return np.full(size, -1, np.int64), np.zeros(size, np.int64)


def _taps(kernel: Triple) -> list[Triple]:
    """Taps z y x of a kernel in memory order."""
    return list(itertools.product(range(kernel[0]), range(kernel[1]), range(kernel[2])))


def _starts(counts: list[int]) -> tuple[int, ...]:
    return tuple(itertools.accumulate(counts, initial=0))


def _submanifold_rulebook(sites: Sites, kernel: Triple) -> Rulebook:
    taps = _taps(kernel)
    half = len(taps) // 2
    centre = taps[half]
    offsets = torch.tensor([[t - c for t, c in zip(tap, centre)] for tap in taps[:half]], dtype=torch.int64)
    if sites.coords.device.type == "cpu":
        source, target, counts = _neighbours_cpu(sites, offsets.view(-1, 3))
    else:
        offsets = offsets.view(-1, 3).to(sites.coords.device)
        source, target, counts = _sparse_torch.neighbour_pairs(sites.coords, sites.shape, offsets)
    # If j lies at an offset from i, then i lies at the opposite offset from j: half of the search is enough.
    opposite_source, opposite_target = (
        torch.cat(rows.split(counts)[::-1]) if half else rows for rows in (target, source)
    )
    starts = _starts([*counts, 0, *counts[::-1]])
    both = torch.cat([source, opposite_source]), torch.cat([target, opposite_target])
    return Rulebook(*both, starts, len(sites), len(sites), half)


def _neighbours_cpu(sites: Sites, offsets: Tensor) -> tuple[Tensor, Tensor, list[int]]:
    from detection.ops import _sparse_kernels

    keys, rows = sites.table()
    source, target = np.empty((2, len(sites) * len(offsets)), np.int64)
    counts = np.zeros(len(offsets), np.int64)
    coords = sites.coords.contiguous().numpy()
    total = _sparse_kernels.neighbour_pairs(
        coords, np.array(sites.shape), offsets.numpy(), keys, rows, source, target, counts
    )
    return torch.from_numpy(source[:total].copy()), torch.from_numpy(target[:total].copy()), counts.tolist()


def _strided_rulebook(sites: Sites, kernel: Triple, stride: Triple, padding: Triple) -> tuple[Sites, Rulebook]:
    shape = tuple((n + 2 * p - k) // s + 1 for n, p, k, s in zip(sites.shape, padding, kernel, stride))
    if min(shape) < 1:
        raise ValueError(f"sparse convolution: a grid of {sites.shape} is smaller than the kernel {kernel}")
    out_shape = (shape[0], shape[1], shape[2])
    taps = torch.tensor(_taps(kernel), dtype=torch.int64)
    steps, margins = torch.tensor(stride), torch.tensor(padding)
    device = sites.coords.device
    if device.type == "cpu":
        found = _windows_cpu(sites, taps, steps, margins, out_shape)
    else:
        found = _sparse_torch.window_pairs(
            sites.coords, taps.to(device), steps.to(device), margins.to(device), out_shape
        )
    keys, source, target, counts = found
    outputs = Sites(_sparse_torch.unravel(keys, out_shape), out_shape, sites.batch)
    return outputs, Rulebook(source, target, _starts(counts), len(sites), len(outputs), None)


def _windows_cpu(
    sites: Sites, taps: Tensor, stride: Tensor, padding: Tensor, out_shape: Triple
) -> tuple[Tensor, Tensor, Tensor, list[int]]:
    from detection.ops import _sparse_kernels

    kernel = taps[-1] + 1
    # Windows of a voxel at most: ceil(kernel / stride) along each axis.
    most = len(sites) * int((-(-kernel // stride)).prod())
    keys, rows = _empty_table(most)
    out_keys, source, target = np.empty((3, most), np.int64)
    counts = np.zeros(len(taps), np.int64)
    steps, margins = stride.numpy(), padding.numpy()
    total, outputs = _sparse_kernels.window_pairs(
        sites.coords.contiguous().numpy(),
        taps.numpy(),
        steps,
        margins,
        np.array(out_shape),
        keys,
        rows,
        out_keys,
        source,
        target,
        counts,
    )
    order = np.argsort(out_keys[:outputs])
    rank = np.empty(outputs, np.int64)
    rank[order] = np.arange(outputs)
    pairs = torch.from_numpy(source[:total].copy()), torch.from_numpy(rank[target[:total]])
    return torch.from_numpy(out_keys[order]), *pairs, counts.tolist()


_FEWEST_ROWS = 2048  # per thread


def _add_rows(out: Tensor, index: Tensor, rows: Tensor) -> None:
    """out[index] += rows in place; `index` names no row twice."""
    if out.device.type != "cpu":
        out.index_add_(0, index, rows)
        return
    from detection.ops import _sparse_kernels
    from detection.ops._numba import for_ranges

    target, places, values = out.numpy(), index.numpy(), rows.numpy()

    def add(i: int, j: int) -> None:
        _sparse_kernels.add_rows(target, places[i:j], values[i:j])

    for_ranges(add, len(values), torch.get_num_threads(), _FEWEST_ROWS)


class _SparseConvolution(torch.autograd.Function):
    """Gather, multiply, scatter; the backward pass walks the same pairs the other way."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, matrices: Tensor, book: Rulebook) -> Tensor:
        ctx.save_for_backward(features, matrices)
        ctx.book = book
        if book.identity is None:
            out = features.new_zeros(book.targets, matrices.shape[2])
        else:
            out = features @ matrices[book.identity]
        for k, source, target in book.taps():
            _add_rows(out, target, features.index_select(0, source) @ matrices[k])
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor, Tensor, None]:
        features, matrices = ctx.saved_tensors
        book: Rulebook = ctx.book
        gradient = gradients[0].contiguous()
        to_matrices = torch.zeros_like(matrices)
        if book.identity is None:
            to_features = torch.zeros_like(features)
        else:
            to_features = gradient @ matrices[book.identity].T
            to_matrices[book.identity] = features.T @ gradient
        for k, source, target in book.taps():
            rows = gradient.index_select(0, target)
            to_matrices[k] = features.index_select(0, source).T @ rows
            _add_rows(to_features, source, rows @ matrices[k].T)
        return to_features, to_matrices, None


def sparse_convolution(features: Tensor, weight: Tensor, book: Rulebook) -> Tensor:
    """Cross-correlation over active voxels only: (N, in) -> (M, out); differentiable in both tensors.

    features  (book.sources, in)         weight  (out, kz, ky, kx, in), spconv 2.x's layout
    Equals a dense convolution of the zero-filled grid, read at the active outputs. Raises ValueError for other shapes.
    """
    if features.shape != (book.sources, weight.shape[-1]) or math.prod(weight.shape[1:4]) + 1 != len(book.starts):
        raise ValueError(
            f"sparse convolution: expected ({book.sources}, {weight.shape[-1]}) features and {len(book.starts) - 1} "
            f"kernel taps, got {tuple(features.shape)} and a weight of {tuple(weight.shape)}"
        )
    matrices = weight.flatten(1, 3).permute(1, 2, 0).contiguous()
    out: Tensor = _SparseConvolution.apply(features.contiguous(), matrices, book)
    return out
