"""Fused normalisation equals PyTorch's batch normalisation, ReLU and maximum: values, gradients, running statistics."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from detection.models.layers import RowBatchNorm
from detection.ops import norm


def layer(channels: int, seed: int) -> RowBatchNorm:
    torch.manual_seed(seed)
    made = RowBatchNorm(channels)
    torch.nn.init.normal_(made.weight)
    torch.nn.init.normal_(made.bias)
    return made


@pytest.mark.parametrize("shape", [(2, 3), (700, 5), (40, 16, 24), (3000, 8, 16)])
def test_relu_matches_torch(shape: tuple[int, ...]) -> None:
    ours, plain = layer(shape[-1], 1), layer(shape[-1], 1)
    rows = (torch.randn(shape) * 3 + 5).requires_grad_()
    twin = rows.detach().clone().requires_grad_()
    grad = torch.randn(shape)
    out, expected = ours.relu(rows), F.relu(plain(twin))
    (out * grad).sum().backward()
    (expected * grad).sum().backward()
    torch.testing.assert_close(out, expected, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(rows.grad, twin.grad, rtol=1e-4, atol=1e-5)
    # Sums over all rows: float32 sums of PyTorch are good to 1e-4 here, ours are float64.
    torch.testing.assert_close(ours.weight.grad, plain.weight.grad, rtol=1e-4, atol=2e-3)
    torch.testing.assert_close(ours.bias.grad, plain.bias.grad, rtol=1e-4, atol=2e-3)
    torch.testing.assert_close(dict(ours.named_buffers()), dict(plain.named_buffers()), rtol=1e-5, atol=1e-5)


def test_maximum_matches_torch_with_equal_neighbours() -> None:
    ours, plain = layer(12, 2), layer(12, 2)
    rows = torch.randn(600, 16, 12)
    rows[:, 5:] = rows[:, 2:3]  # groups repeat their first neighbour when they are not full
    rows = rows.requires_grad_()
    twin = rows.detach().clone().requires_grad_()
    grad = torch.randn(600, 12)
    out, expected = ours.relu_maximum(rows), F.relu(plain(twin).max(dim=1).values)
    (out * grad).sum().backward()
    (expected * grad).sum().backward()
    torch.testing.assert_close(out, expected, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(rows.grad, twin.grad, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(ours.weight.grad, plain.weight.grad, rtol=1e-4, atol=2e-3)
    torch.testing.assert_close(dict(ours.named_buffers()), dict(plain.named_buffers()), rtol=1e-5, atol=1e-5)


def test_a_negative_scale_turns_the_order_round() -> None:
    """By hand: values 1 and 3 normalise to -1 and 1; weight -2 makes them 2 and -2, so the smaller one wins."""
    rows = torch.tensor([[[1.0], [3.0]]])
    out, (mean, variance) = norm.norm_relu_maximum(rows, torch.tensor([-2.0]), torch.tensor([0.0]), 0.0)
    assert out.tolist() == [[2.0]]
    assert (mean.item(), variance.item()) == (2.0, 1.0)


def test_results_do_not_depend_on_threads() -> None:
    rows, weight, bias = torch.randn(5000, 24), torch.randn(24), torch.randn(24)
    before = torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            given = rows.clone().requires_grad_()
            out, moments = norm.norm_relu(given, weight, bias, 1e-5)
            out.square().sum().backward()
            found.append((out.detach(), given.grad, *moments))
    finally:
        torch.set_num_threads(before)
    for one, two in zip(*found):
        assert torch.equal(one, two)


def test_other_types_and_fixed_statistics_take_the_plain_way() -> None:
    made = layer(4, 3)
    assert made.double().relu(torch.randn(9, 4, dtype=torch.float64)).dtype == torch.float64
    made = layer(4, 3).eval()
    rows = torch.randn(9, 4)
    torch.testing.assert_close(made.relu(rows), F.relu(made(rows)))
