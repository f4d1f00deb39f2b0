"""The bundled Depth Coefficients network: untrained it is the rings, and it starts from the selection network."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from completion.backends import kernel_executor
from completion.depth_coefficients import Bins, decode_logits
from completion.growth import adopt
from completion.infer import NetworkCompleter, network_completer
from completion.models import build_model, default_spec
from completion.models.ring_coefficients import RingCoefficients, ring_coefficients
from completion.models.rings import Rings, find_rings
from completion.models.selection import Selection
from completion.training_loss import LossSettings, training_loss
from tests.completion.scenes import street
from tests.completion.test_selection import tensors


def untrained() -> RingCoefficients:
    model = RingCoefficients(width=8)
    torch.nn.init.zeros_(model.network.head.weight)
    return model.eval()


def test_the_coefficients_of_an_edge_by_hand() -> None:
    one = torch.ones(1, 1, 1, 1)
    rings = Rings(10 * one, 20 * one, 13.5 * one, one, one)
    found = ring_coefficients(rings, Bins(80, 1.0))[0, :, 0, 0]
    expected = torch.zeros(82)
    expected[[9, 10, 11, 19, 20, 21]] = torch.tensor([0.25, 0.5, 0.25] * 2) / 3
    # 13.5 m rounds to bin 14 (ties to even) with delta -0.5.
    expected[[13, 14]] = torch.tensor([0.5, 0.5]) / 3
    torch.testing.assert_close(found, expected)
    assert float((found * torch.arange(82)).sum()) == pytest.approx((10 + 20 + 13.5) / 3, rel=1e-5)


def test_untrained_it_reads_one_of_the_rings_where_they_agree() -> None:
    sparse, rgb = tensors(street(1, 64, 160))
    rings = find_rings(sparse)
    with torch.inference_mode():
        (logits,) = untrained()(sparse, rgb)
    depth = decode_logits(logits, Bins(), "peak")
    agree = ((rings.above - rings.below).abs() < 0.02)[:, 0] & (rings.between < 79)[:, 0]
    assert agree.float().mean() > 0.2
    torch.testing.assert_close(depth[agree], rings.between[:, 0][agree], atol=0.05, rtol=0)


def test_training_lowers_the_entropy_and_reaches_every_layer() -> None:
    spec = default_spec("ring_coefficients", width=8)
    torch.manual_seed(0)
    model = build_model(spec)
    frame = street(1, 64, 160)
    sparse, rgb = tensors(frame)
    assert frame.target is not None
    target = torch.from_numpy(frame.target)[None, None]
    optimiser = torch.optim.Adam(model.parameters(), lr=2e-3)
    losses = []
    for _ in range(25):
        loss = training_loss(model(sparse, rgb), sparse, target, spec, LossSettings(kind="dc"), (1.0,), 0.0)["loss"]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.85 * losses[0]
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in model.parameters())


def test_it_begins_with_the_layers_of_a_selection_network() -> None:
    source, target = Selection(width=8), RingCoefficients(width=8)
    head = target.network.head.weight.clone()
    assert adopt(source, target) == ["network.head.weight", "network.head.bias"]
    assert torch.equal(source.network.stem.weight, target.network.stem.weight)
    assert torch.equal(head, target.network.head.weight)
    with pytest.raises(ValueError, match="nothing in common"):
        adopt(torch.nn.Linear(2, 2), target)


@pytest.mark.parametrize(("decoding", "threads"), [("peak", 1), ("peak", 2), ("all", 1)])
def test_the_fast_pass_agrees_with_torch(decoding: str, threads: int) -> None:
    """Uneven sizes, empty and dense maps, coarse bins that near and far depths leave: the same depth to a millimetre,
    but for pixels whose two largest coefficients are equal to rounding."""
    torch.manual_seed(3)
    spec = default_spec("ring_coefficients", width=8, count=30, size=2.0)
    model = RingCoefficients(width=8, count=30, size=2.0)
    torch.nn.init.normal_(model.network.head.weight, std=0.5)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        fast = NetworkCompleter(kernel_executor(model, spec, decoding))
    finally:
        torch.set_num_threads(before)
    slow = network_completer(model, spec, decoding=decoding)
    for height, width, row_step in ((75, 200, 9), (64, 96, 1), (33, 131, 500)):
        frame = street(7, height, width, row_step)
        found, expected = (one.complete(frame.sparse, frame.image) for one in (fast, slow))
        assert found.foreground is None
        assert np.mean(np.abs(found.depth - expected.depth) > 1e-3) < 1e-4
    first, other = street(1, 64, 96), street(2, 64, 96)
    before, _, after = (fast.complete(frame.sparse, frame.image).depth for frame in (first, other, first))
    np.testing.assert_array_equal(before, after)  # nothing is left in memory kept from frame to frame


def test_any_image_size_completes_to_one_depth() -> None:
    frame = street(2, 75, 133)
    completer = network_completer(untrained(), default_spec("ring_coefficients", width=8), decoding="peak")
    completed = completer.complete(frame.sparse, frame.image)
    assert completed.depth.shape == (75, 133)
    assert completed.foreground is None
    assert np.isfinite(completed.depth).all()
    assert completed.depth.max() <= 80
