"""Sparse convolution against dense convolution: active sites, values and gradients."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

from detection.ops import _sparse_torch, sparse_conv
from detection.ops.sparse_conv import Sites, sparse_convolution
from tests.reference.voxel_sparse import active_outputs, dense_convolution

SHAPE = (5, 7, 6)
STRIDED = [((3, 3, 3), (2, 2, 2), (1, 1, 1)), ((3, 3, 3), (2, 2, 2), (0, 1, 1)), ((3, 1, 1), (2, 1, 1), (0, 0, 0))]


def some_sites(count: int = 60, seed: int = 0) -> Sites:
    """Sites of two frames in a shuffled order."""
    generator = torch.Generator().manual_seed(seed)
    cells = torch.randperm(2 * SHAPE[0] * SHAPE[1] * SHAPE[2], generator=generator)[:count]
    return Sites(_sparse_torch.unravel(cells, SHAPE), SHAPE, 2)


def read(dense: Tensor, coords: Tensor) -> Tensor:
    """Values (M, C) of (B, C, Z, Y, X) at coords (M, 4)."""
    b, z, y, x = coords.T
    return dense[b, :, z, y, x]


def gradients(value: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
    weights = torch.linspace(-1, 1, value.numel(), dtype=value.dtype).view_as(value)
    return torch.autograd.grad((value * weights).sum(), inputs)


@pytest.mark.parametrize("kernel", [(3, 3, 3), (1, 3, 5), (1, 1, 1)])
def test_submanifold_equals_dense_on_the_active_set(kernel) -> None:
    sites = some_sites()
    features = torch.randn(len(sites), 4, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(3, *kernel, 4, dtype=torch.float64, requires_grad=True)
    out = sparse_convolution(features, weight, sites.submanifold(kernel))
    padding = tuple(k // 2 for k in kernel)
    expected = read(dense_convolution(sites.to_dense(features), weight, (1, 1, 1), padding), sites.coords)
    torch.testing.assert_close(out, expected)
    for ours, theirs in zip(gradients(out, features, weight), gradients(expected, features, weight)):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize(("kernel", "stride", "padding"), STRIDED)
def test_strided_equals_dense_and_finds_its_active_set(kernel, stride, padding) -> None:
    sites = some_sites()
    features = torch.randn(len(sites), 4, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(3, *kernel, 4, dtype=torch.float64, requires_grad=True)
    outputs, book = sites.strided(kernel, stride, padding)
    active = sites.to_dense(torch.ones(len(sites), 1))[:, 0]
    assert torch.equal(outputs.coords, active_outputs(active, kernel, stride, padding))
    out = sparse_convolution(features, weight, book)
    expected = read(dense_convolution(sites.to_dense(features), weight, stride, padding), outputs.coords)
    torch.testing.assert_close(out, expected)
    for ours, theirs in zip(gradients(out, features, weight), gradients(expected, features, weight)):
        torch.testing.assert_close(ours, theirs)


def test_numba_and_torch_find_the_same_pairs() -> None:
    sites = some_sites(150, seed=3)
    offsets = torch.tensor(list(itertools.product((-1, 0, 1), repeat=3)))
    ours = sparse_conv._neighbours_cpu(sites, offsets)
    theirs = _sparse_torch.neighbour_pairs(sites.coords, SHAPE, offsets)
    assert torch.equal(ours[0], theirs[0])
    assert torch.equal(ours[1], theirs[1])
    assert ours[2] == theirs[2]
    for kernel, stride, padding in STRIDED:
        taps = torch.tensor(list(itertools.product(*map(range, kernel))))
        shape = sites.strided(kernel, stride, padding)[0].shape
        steps, margins = torch.tensor(stride), torch.tensor(padding)
        ours_strided = sparse_conv._windows_cpu(sites, taps, steps, margins, shape)
        theirs_strided = _sparse_torch.window_pairs(sites.coords, taps, steps, margins, shape)
        assert all(torch.equal(a, b) for a, b in zip(ours_strided[:3], theirs_strided[:3]))
        assert ours_strided[3] == theirs_strided[3]


def test_gradcheck_of_a_chain_with_shared_indices() -> None:
    sites = some_sites(20)
    assert sites.submanifold((3, 3, 3)) is sites.submanifold((3, 3, 3))
    weight = torch.randn(2, 3, 3, 3, 2, dtype=torch.float64, requires_grad=True)
    features = torch.randn(len(sites), 2, dtype=torch.float64, requires_grad=True)

    def twice(values: Tensor, kernel: Tensor) -> Tensor:
        book = sites.submanifold((3, 3, 3))
        return sparse_convolution(sparse_convolution(values, kernel, book).tanh(), kernel, book)

    assert torch.autograd.gradcheck(twice, (features, weight))


def test_more_threads_change_nothing() -> None:
    sites, threads = some_sites(400), torch.get_num_threads()
    features, weight = torch.randn(400, 8), torch.randn(8, 3, 3, 3, 8)
    book = sites.submanifold((3, 3, 3))
    try:
        torch.set_num_threads(1)
        alone = sparse_convolution(features, weight, book)
        torch.set_num_threads(2)
        together = sparse_convolution(features, weight, book)
    finally:
        torch.set_num_threads(threads)
    torch.testing.assert_close(alone, together, rtol=1e-5, atol=1e-5)


def test_no_sites_give_no_sites() -> None:
    sites = some_sites(0)
    outputs, book = sites.strided((3, 3, 3), (2, 2, 2), (1, 1, 1))
    assert sparse_convolution(torch.zeros(0, 2), torch.ones(3, 3, 3, 3, 2), book).shape == (0, 3)
    assert sparse_convolution(torch.zeros(0, 2), torch.ones(3, 3, 3, 3, 2), sites.submanifold((3, 3, 3))).shape == (
        0,
        3,
    )
    assert len(outputs) == 0
    assert not outputs.to_dense(torch.zeros(0, 3)).any()


def test_wrong_arguments_are_named() -> None:
    sites = some_sites(10)
    with pytest.raises(ValueError, match="odd kernel"):
        sites.submanifold((2, 3, 3))
    with pytest.raises(ValueError, match="smaller than the kernel"):
        sites.strided((9, 3, 3), (1, 1, 1), (0, 0, 0))
    with pytest.raises(ValueError, match="kernel taps"):
        sparse_convolution(torch.zeros(10, 2), torch.zeros(3, 1, 1, 1, 2), sites.submanifold((3, 3, 3)))
    with pytest.raises(ValueError, match="int64 b z y x"):
        Sites(torch.zeros(3, 3), SHAPE, 1)
