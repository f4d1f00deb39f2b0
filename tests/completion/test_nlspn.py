"""NLSPN: both deformable operations against their twin and by gradients, every affinity, sizes, counts."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor

from completion.cpu.propagation import confidence_times, propagated
from completion.cpu.row_threads import RowThreads
from completion.inputs import scale_rgb
from completion.models import build_model, default_spec
from completion.models.deformable import propagate, sample, times_confidence
from completion.models.nlspn import AFFINITIES, NLSPN, NonLocalPropagation
from completion.training_loss import LossSettings, training_loss
from tests.completion.scenes import street
from tests.reference import completion_deformable as twin

SIZE = (6, 7)


def maps(*shape: int, seed: int = 0, scale: float = 1.0) -> Tensor:
    return torch.randn(*shape, *SIZE, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * scale


def small(*shape: int, seed: int = 0) -> Tensor:
    """For derivatives by differences: 2 x 3 pixels."""
    return maps(1, *shape, seed=seed)[..., :2, :3].clone()


def array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor[0].float().numpy())


@pytest.mark.parametrize("kernel", [3, 5])
@pytest.mark.parametrize("threads", [1, 3])
def test_propagation_is_the_twins(kernel: int, threads: int) -> None:
    """Offsets of several pixels: many samples lie outside; whole ones and those far outside are among them."""
    offsets, weights = maps(1, kernel**2, 2, scale=2.0), maps(1, kernel**2, seed=1, scale=0.2)
    offsets[0, 0, :, 0, 0] = torch.tensor([-1.0, -1.0])
    offsets[0, 1, :, 2, 2] = torch.tensor([1e9, -1e30])
    offsets[0, 2, :, 3, 3] = torch.tensor([2.0, 0.5])
    offsets[:, kernel**2 // 2] = 0
    depth, kept = 10 + maps(1, 1, seed=2), torch.where(maps(1, 1, seed=3) > 0.5, 5.0, 0.0).double()
    for measured in (None, kept):
        plain = None if measured is None else measured[0, 0].numpy()
        expected = twin.propagate(depth[0, 0].numpy(), offsets[0].numpy(), weights[0].numpy(), 3, plain)
        steps = propagate(depth, offsets, weights, 3, measured)
        assert len(steps) == 3
        np.testing.assert_allclose(steps[-1][0, 0].numpy(), expected, atol=1e-12)
        fast = propagated(
            array(depth)[0],
            array(offsets),
            array(weights),
            3,
            None if measured is None else array(measured)[0],
            RowThreads(threads),
        )
        np.testing.assert_allclose(fast, expected, rtol=2e-5, atol=2e-5)


def test_confidence_is_the_twins() -> None:
    affinities, confidence, offsets = maps(1, 8), maps(1, 1, seed=1).sigmoid(), maps(1, 8, 2, seed=2, scale=3.0)
    expected = twin.confidence_times(affinities[0].numpy(), confidence[0, 0].numpy(), offsets[0].numpy())
    np.testing.assert_allclose(times_confidence(affinities, confidence, offsets)[0].numpy(), expected, atol=1e-12)
    fast = confidence_times(array(affinities), array(confidence)[0], array(offsets), RowThreads(1))
    np.testing.assert_allclose(fast, expected, rtol=1e-5, atol=1e-5)


def test_a_neighbour_that_is_nowhere_spoils_its_own_pixel_only() -> None:
    offsets, weights, depth = maps(1, 9, 2), maps(1, 9, seed=1), maps(1, 1, seed=2)
    offsets[0, 3, 0, 2, 5] = torch.nan
    spoilt = np.argwhere(np.isnan(propagate(depth, offsets, weights, 1)[-1][0, 0].numpy()))
    fast = propagated(array(depth)[0], array(offsets), array(weights), 1, None, RowThreads(1))
    assert spoilt.tolist() == np.argwhere(np.isnan(fast)).tolist() == [[2, 5]]


def test_kernels_refuse_arrays_that_do_not_fit() -> None:
    depth, offsets, weights = array(maps(1, 1))[0], array(maps(1, 9, 2)), array(maps(1, 9))
    with pytest.raises(ValueError, match="offsets: expected float32 of shape"):
        propagated(depth, offsets[:8], weights, 1, None, RowThreads(1))
    with pytest.raises(ValueError, match="square of an odd number"):
        propagated(depth, offsets[:4], weights[:4], 1, None, RowThreads(1))
    with pytest.raises(ValueError, match="affinities: expected float32"):
        confidence_times(weights.astype(np.float64), depth, offsets, RowThreads(1))


def test_gradients_of_depth_offsets_weights_and_confidence() -> None:
    depth, offsets = small(1).requires_grad_(), small(9, 2, seed=1).requires_grad_()
    weights, kept = small(9, seed=2).requires_grad_(), (small(1, seed=3) > 0.8).double()
    assert torch.autograd.gradcheck(lambda d, o, w: propagate(d, o, w, 2, kept)[-1], (depth, offsets, weights))
    around = [(0, 0), (-1, 1)]
    assert torch.autograd.gradcheck(
        lambda c, o: sample(c, o, around), (depth, offsets[:, :2].detach().requires_grad_())
    )
    affinities = small(8, seed=4).requires_grad_()
    moving = offsets[:, :8].detach().requires_grad_()
    times_confidence(affinities, depth, moving).sum().backward()
    assert moving.grad is None  # as published: the confidence does not move the neighbours
    assert depth.grad is not None
    assert affinities.grad is not None


def layer(
    affinity: str = "TGASS", legacy: bool = False, preserve: bool = False, scale: float = 0.5
) -> NonLocalPropagation:
    made = NonLocalPropagation(3, affinity, 4, legacy, preserve).double()
    torch.nn.init.normal_(made.conv_offset_aff.weight, std=scale, generator=torch.Generator().manual_seed(5))
    torch.nn.init.normal_(made.conv_offset_aff.bias, std=scale, generator=torch.Generator().manual_seed(6))  # type: ignore[arg-type]
    return made


@pytest.mark.parametrize(
    ("affinity", "legacy", "confident"), list(product(AFFINITIES, (False, True), (False, True))), ids=str
)
def test_offsets_and_weights_are_the_twins(affinity: str, legacy: bool, confident: bool) -> None:
    made = layer(affinity, legacy)
    guidance, confidence = maps(1, 8, seed=7), maps(1, 1, seed=8).sigmoid() if confident else None
    with torch.no_grad():
        found = made(maps(1, 1), guidance, confidence, maps(1, 1))
        raw = made.conv_offset_aff(guidance)[0].numpy()
    scale = {"TC": 8.0, "TGASS": 4.0}.get(affinity, 1.0)
    assert float(made.aff_scale_const.detach()) == scale
    assert made.aff_scale_const.requires_grad == (affinity == "TGASS")
    plain = None if confidence is None else confidence[0, 0].numpy()
    offsets, weights = twin.offsets_and_weights(raw, plain, affinity, scale, legacy)
    np.testing.assert_allclose(found.offsets[0].numpy(), offsets.reshape(18, *SIZE), atol=1e-12)
    np.testing.assert_allclose(found.weights[0].numpy(), weights, atol=1e-12)
    np.testing.assert_allclose(weights.sum(0), 1, atol=1e-12)
    np.testing.assert_allclose(
        found.steps[-1][0, 0].numpy(), twin.propagate(maps(1, 1)[0, 0].numpy(), offsets, weights, 4), atol=1e-10
    )


def test_legacy_reads_two_cells_away() -> None:
    """No offsets, one affinity: the right neighbour. The depth is read two columns to the right, its confidence one."""
    made = layer(legacy=True, scale=0.0)
    with torch.no_grad():
        made.conv_offset_aff.bias[16 + 4] = 20.0  # type: ignore[index]  # neighbour 4 of 8: (0, +1), tanh 1, over g = 4
    confidence, depth = torch.zeros(1, 1, *SIZE).double(), torch.zeros(1, 1, *SIZE).double()
    confidence[0, 0, 3, 4], depth[0, 0, 3, 5] = 0.5, 8.0
    with torch.no_grad():
        found = made(depth, maps(1, 8), confidence, depth)
        first = found.steps[0][0, 0]
        assert float(found.weights[0, 5, 3, 3]) == pytest.approx(0.125)
        assert float(first[3, 3]) == pytest.approx(0.125 * 8)
        assert found.offsets[0, 10:12, 0, 0].tolist() == [0, 1]
        made.legacy = False
        assert float(made(depth, maps(1, 8), confidence, depth).steps[0][0, 0, 3, 4]) == pytest.approx(0.125 * 8)


def test_measured_depth_replaces_the_map_before_each_iteration() -> None:
    sparse = torch.where(maps(1, 1, seed=9) > 0.5, 7.0, 0.0).double()
    made = layer(preserve=True)
    with torch.no_grad():
        found = made(maps(1, 1), maps(1, 8), None, sparse)
        made.preserve_input, made.iterations = False, 1
        again = made(torch.where(sparse > 0, sparse, found.steps[2]), maps(1, 8), None, sparse)
    assert torch.equal(found.steps[3], again.steps[0])
    assert not torch.equal(found.steps[3][sparse > 0], sparse[sparse > 0])


def test_published_sizes() -> None:
    def count(**arguments: int | bool) -> tuple[int, int, int]:
        with torch.device("meta"):
            model = NLSPN(**arguments)  # type: ignore[arg-type]
        sizes = [(p.numel(), p.requires_grad) for p in model.parameters()]
        return sum(n for n, _ in sizes), sum(n for n, trained in sizes if trained), len(model.state_dict())

    assert count() == (26_231_790, 26_231_779, 274)
    assert count(layers=18) == (16_123_630, 16_123_619, 178)
    assert not any(name.startswith("cf_") for name in NLSPN(width=4, layers=18, confidence=False).state_dict())


@pytest.mark.parametrize("size", [(33, 47), (16, 16), (5, 30)])
def test_any_size_and_batches_of_singles(size: tuple[int, int]) -> None:
    torch.manual_seed(0)
    model = NLSPN(layers=18, width=8, iterations=3).eval()
    sparse, rgb = torch.rand(2, 1, *size) * 20, torch.randn(2, 3, *size)
    with torch.no_grad():
        untrained = model.outputs(sparse, rgb)
        expected = torch.where(sparse > 0, sparse, untrained.initial).clamp(min=0)
        assert torch.equal(untrained.depth, expected)  # no affinities yet: the layer is the identity
        torch.nn.init.normal_(model.prop_layer.conv_offset_aff.weight, std=0.3)
        both = model(sparse, rgb)
        singles = torch.cat([model(sparse[i : i + 1], rgb[i : i + 1]) for i in (0, 1)])
    assert both.shape == (2, 1, *size)
    assert not torch.equal(both, expected)
    torch.testing.assert_close(both, singles, atol=1e-4, rtol=1e-4)


def test_wrong_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="affinity: expected one of AS, ASS, TC, TGASS"):
        NLSPN(affinity="tgass", width=4)
    with pytest.raises(ValueError, match="kernel: expected an odd number"):
        NLSPN(kernel=4, width=4)
    with pytest.raises(ValueError, match="colour"):
        NLSPN(layers=18, width=4)(torch.zeros(1, 1, 8, 8), torch.zeros(1, 3, 8, 9))


def test_it_overfits_two_frames() -> None:
    torch.manual_seed(0)
    spec = default_spec("nlspn", layers=18, width=8, iterations=3)
    model = build_model(spec)
    frames = [street(seed, 24, 40, 6) for seed in (1, 2)]
    sparse, target = (
        torch.from_numpy(np.stack([getattr(f, name) for f in frames]))[:, None] for name in ("sparse", "target")
    )
    rgb = scale_rgb(torch.from_numpy(np.stack([f.image for f in frames])).permute(0, 3, 1, 2), spec.rgb)
    optimiser = torch.optim.Adam(model.parameters(), lr=5e-3)

    def error() -> float:
        with torch.no_grad():
            return float((model.eval()(sparse, rgb) - target).abs().mean())

    untrained = error()
    for _ in range(100):
        optimiser.zero_grad()
        outputs = (model.train()(sparse, rgb),)
        training_loss(outputs, sparse, target, spec, LossSettings("l1_l2"), (1.0,), 0.0)["loss"].backward()
        optimiser.step()
    assert untrained > 20
    assert error() < 2
    assert all(p.grad is not None for p in model.parameters() if p.requires_grad)
    assert float(model.prop_layer.conv_offset_aff.weight.detach().abs().max()) > 0.01
