"""The selection network: candidates, batches, save and load, learning an edge, and its fused pass for the CPU."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from completion.backends import torch_executor
from completion.checkpoints import Card, load_checkpoint, save_checkpoint
from completion.decoding import MIXTURE_DECODINGS, decode_output
from completion.inputs import scale_rgb
from completion.mixture import negative_log_likelihood, twin_surfaces
from completion.models import build_model, default_spec
from completion.models.rings import find_rings
from completion.models.selection import CANDIDATES, CHANNELS, Selection, candidate_depths
from completion.types import DepthFrame
from tests.completion.scenes import street


def small(seed: int = 0, head: float = 0.01) -> Selection:
    """A narrow network; `head` is the deviation of its last weights (0.01 when trained from scratch)."""
    torch.manual_seed(seed)
    model = Selection(width=8)
    torch.nn.init.normal_(model.network.head.weight, std=head)
    return model.eval()


def tensors(frame: DepthFrame) -> tuple[torch.Tensor, torch.Tensor]:
    rgb = torch.from_numpy(frame.image).permute(2, 0, 1)[None]
    return torch.from_numpy(frame.sparse)[None, None], scale_rgb(rgb, "standardised")


@pytest.mark.parametrize("size", [(32, 32), (64, 160), (96, 32)])
def test_any_multiple_of_32(size: tuple[int, int]) -> None:
    with torch.inference_mode():
        (mixture,) = small()(*tensors(street(1, *size)))
    assert mixture.shape == (1, CHANNELS, *size)
    with pytest.raises(ValueError, match="multiples of 32"):
        small()(torch.zeros(1, 1, 48, 64), torch.zeros(1, 3, 48, 64))


def test_without_any_sample_everything_is_finite() -> None:
    with torch.inference_mode():
        (mixture,) = small(head=1.0)(torch.zeros(1, 1, 64, 64), torch.rand(1, 3, 64, 64))
        surfaces = twin_surfaces(mixture)
    assert torch.isfinite(mixture).all()
    assert all(torch.isfinite(part).all() for part in surfaces)
    assert float(surfaces[0].min()) > 0


def test_a_batch_is_its_images_one_by_one() -> None:
    model, frames = small(), [tensors(street(seed, 64, 96)) for seed in range(3)]
    with torch.inference_mode():
        (together,) = model(*(torch.cat(part) for part in zip(*frames)))
        for one, frame in zip(together, frames):
            torch.testing.assert_close(one, model(*frame)[0][0], rtol=1e-4, atol=1e-5)


def test_candidates_of_neighbouring_columns(rng: np.random.Generator) -> None:
    """Shifts 0, -6, 6, each above, below, between; beyond the border the border's."""
    sparse = torch.from_numpy((rng.uniform(2, 60, (20, 30)) * (rng.random((20, 30)) < 0.1)).astype(np.float32))
    rings = find_rings(sparse[None, None])
    found = candidate_depths(rings)[0]
    assert len(found) == CANDIDATES - 1
    for number, own in enumerate((rings.above, rings.below, rings.between)):
        own = own[0, 0]
        assert torch.equal(found[number], own)
        assert torch.equal(found[3 + number][:, 6:], own[:, :-6])
        assert torch.equal(found[3 + number][:, :6], own[:, :1].expand(-1, 6))
        assert torch.equal(found[6 + number][:, :-6], own[:, 6:])
        assert torch.equal(found[6 + number][:, -6:], own[:, -1:].expand(-1, 6))


def test_a_silent_network_offers_the_candidates_with_equal_weight() -> None:
    model = small(head=0.0)
    sparse, rgb = tensors(street(2, 64, 64))
    with torch.inference_mode():
        (mixture,) = model(sparse, rgb)
    rings = find_rings(sparse)
    assert float(mixture[:, :CANDIDATES].abs().max()) == 0
    depths = torch.exp(mixture[:, CANDIDATES:-1])
    torch.testing.assert_close(depths, torch.cat((candidate_depths(rings), rings.between), 1))


def test_round_trip(tmp_path: Path) -> None:
    model, spec = small(), default_spec("selection", width=8)
    path = save_checkpoint(tmp_path / "net", model, Card(spec, "median", {"seed": 0}))
    loaded, card = load_checkpoint(path)
    given = tensors(street(3, 64, 96))
    with torch.inference_mode():
        assert torch.equal(loaded(*given)[0], model(*given)[0])
    assert (card.model, card.decoding) == (spec, "median")


def step_edge(seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A box at 10 m before a wall at 40 m; its upper edge lies somewhere between two rings, unseen in the image."""
    target = torch.full((1, 1, 64, 64), 40.0)
    target[..., 21 + (seed * 7) % 22 :, :] = 10.0
    sparse = torch.zeros_like(target)
    sparse[..., [20, 44], ::2] = target[..., [20, 44], ::2]
    return sparse, torch.zeros(1, 3, 64, 64), target


def test_it_learns_both_sides_of_an_edge() -> None:
    torch.manual_seed(0)
    model = build_model(default_spec("selection", width=8))
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-2)
    losses = []
    for step in range(30):
        sparse, rgb, target = (torch.cat(part) for part in zip(*(step_edge(4 * step + n) for n in range(4))))
        loss = negative_log_likelihood(model(sparse, rgb)[0], target).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert np.mean(losses[-3:]) < 0.5 * losses[0]
    sparse, rgb, target = step_edge(1)
    with torch.inference_mode():
        foreground, background, _, _ = twin_surfaces(model.eval()(sparse, rgb)[0])
    ambiguous = (slice(None), slice(None), slice(28, 36))
    assert float((foreground[ambiguous] <= 1.05 * target[ambiguous]).float().mean()) > 0.95
    assert float((background[ambiguous] >= 0.95 * target[ambiguous]).float().mean()) > 0.95
    assert float((foreground[ambiguous] < 12).float().mean()) > 0.9
    assert float((background[ambiguous] > 35).float().mean()) > 0.9


def test_gradients_reach_every_parameter() -> None:
    model = small(head=0.3)
    for layer in model.network.modules():  # blocks start as identities, behind which nothing moves
        if isinstance(layer, torch.nn.Conv2d):
            torch.nn.init.normal_(layer.weight, std=0.1)
    frame = street(5, 64, 96)
    assert frame.target is not None
    (mixture,) = model(*tensors(frame))
    negative_log_likelihood(mixture, torch.from_numpy(frame.target)[None, None]).mean().backward()
    silent = [name for name, p in model.named_parameters() if p.grad is None or float(p.grad.abs().max()) == 0]
    assert silent == []


@pytest.mark.parametrize(("decoding", "threads"), [*((name, 1) for name in MIXTURE_DECODINGS), ("fused", 2)])
def test_fused_pass_agrees_with_torch(decoding: str, threads: int) -> None:
    """Uneven sizes, empty and dense maps, one thread or two: the same maps to 1e-5 of their value."""
    model, spec = small(4, head=0.4), default_spec("selection", width=8)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        for height, width, row_step in ((75, 200, 9), (64, 96, 1), (33, 131, 500)):
            frame = street(7, height, width, row_step)
            sparse, rgb = tensors(frame)
            top, right = -height % 32, -width % 32
            with torch.inference_mode():
                (mixture,) = model(F.pad(sparse, (0, right, top, 0)), F.pad(rgb, (0, right, top, 0), mode="replicate"))
                expected = decode_output(mixture[:, :, top:, :width], spec, decoding)
                found = torch_executor(model, spec, "cpu", decoding).run(frame.sparse, frame.image)
            for one, other in zip(found, expected):
                assert one is not None
                assert other is not None
                np.testing.assert_allclose(one, other[0].numpy(), rtol=1e-5, atol=1e-6)
    finally:
        torch.set_num_threads(before)


def test_fused_pass_survives_extreme_outputs() -> None:
    """Logits and corrections far beyond float32's exponential."""
    model = small(4, head=300.0)
    frame = street(7, 64, 96)
    spec = default_spec("selection", width=8)
    found = torch_executor(model, spec, "cpu", "expected").run(frame.sparse, frame.image)
    assert found.sigma is not None
    assert all(part is not None and np.isfinite(part).all() for part in found)
    assert found.sigma.max() <= 1
