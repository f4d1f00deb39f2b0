"""TWISE and MultiStack: published sizes, key names, and the algebra between their stages."""

from __future__ import annotations

import re

import pytest
import torch
from torch import Tensor, nn

from completion.models import build_model, default_spec
from completion.models.blocks import upsample2
from completion.models.hourglass import MultiStack, Twise
from tests.reference import completion_twise as reference


def parameters(model: nn.Module) -> int:
    return sum(p.numel() for p in model.parameters())


def inputs(height: int = 32, width: int = 48, batch: int = 2) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(4)
    sparse = torch.rand(batch, 1, height, width, generator=generator)
    sparse = sparse * (torch.rand(sparse.shape, generator=generator) < 0.06)
    return sparse, torch.rand(batch, 3, height, width, generator=generator)


def test_parameter_counts_are_the_published_ones() -> None:
    assert parameters(Twise()) == 1_450_249
    assert parameters(MultiStack()) == 363_971


def test_twise_keys_and_shapes_are_the_published_ones() -> None:
    C = 64
    expected = {f"rgb_encoder.init.{i}": (C, c, 3, 3) for i, c in ((0, 3), (2, C))}
    expected |= {f"rgb_encoder.enc{n}.{i}": (C, C, 3, 3) for n in (1, 2, 3, 4) for i in (1, 3)}
    for stage in (1, 2, 3):
        expected[f"depth_encoder{stage}.init.0"] = (C, 1 if stage == 1 else 2, 3, 3)
        expected[f"depth_encoder{stage}.init.2"] = (C, C, 3, 3)
        expected |= {f"depth_encoder{stage}.enc{n}.{i}": (C, C, 3, 3) for n in (1, 2) for i in (1, 3)}
        expected |= {f"depth_decoder{stage}.dec{n}.{i}": (C, C, 3, 3) for n in (1, 2) for i in (1, 3)}
        expected |= {f"depth_decoder{stage}.prdct.1": (C, C, 3, 3), f"depth_decoder{stage}.prdct.3": (3, C, 3, 3)}
    found = {name: tuple(value.shape) for name, value in Twise().state_dict().items()}
    assert found == {f"{k}.weight": s for k, s in expected.items()} | {
        f"{k}.bias": (s[0],) for k, s in expected.items()
    }
    assert len(found) == 92


@pytest.mark.parametrize("size", [(352, 1216), (256, 1216), (208, 304), (64, 128)])
def test_output_sizes(size: tuple[int, int]) -> None:
    height, width = size
    sparse, rgb = torch.zeros(1, 1, *size), torch.zeros(1, 3, *size)
    with torch.inference_mode():
        shapes = [tuple(out.shape) for out in Twise(channels=2)(sparse, rgb)]
        same = [tuple(out.shape) for out in MultiStack(channels=2)(sparse, rgb)]
    assert shapes == [(1, 3, height // s, width // s) for s in (1, 2, 4)]
    assert same == [(1, 1, height, width)] * 3


@pytest.mark.parametrize("model", [Twise(channels=2), MultiStack(channels=2)])
def test_sizes_that_do_not_fit_are_refused(model: nn.Module) -> None:
    with pytest.raises(ValueError, match="multiples of 16"):
        model(torch.zeros(1, 1, 30, 48), torch.zeros(1, 3, 30, 48))
    with pytest.raises(ValueError, match="expected sparse"):
        model(torch.zeros(1, 1, 32, 48), torch.zeros(1, 3, 32, 32))


@pytest.mark.parametrize("pooling", ["avg", "max"])
def test_twise_outputs_follow_from_its_heads(pooling: str) -> None:
    model = Twise(channels=6, pooling=pooling)
    heads: list[Tensor] = []
    encoded: list[Tensor] = []
    for n in (1, 2, 3):
        getattr(model, f"depth_decoder{n}").register_forward_hook(lambda _m, _i, out: heads.append(out[0]))
        getattr(model, f"depth_encoder{n}").register_forward_hook(lambda _m, given, _o: encoded.append(given[0]))
    sparse, rgb = inputs()
    with torch.no_grad():
        found = model(sparse, rgb)
    r4, r2, r1 = heads
    for ours, expected in zip(found, reference.outputs(r1, r2, r4)):
        torch.testing.assert_close(ours, expected, rtol=1e-5, atol=1e-6)
    p2, p1 = reference.guides(r2, r4)
    torch.testing.assert_close(encoded[1][:, 1:], p2, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(encoded[2][:, 1:], p1, rtol=1e-5, atol=1e-6)
    assert torch.equal(encoded[2][:, :1], sparse)
    if pooling == "avg":
        torch.testing.assert_close(encoded[0], reference.pooled(sparse, 4))
        torch.testing.assert_close(encoded[1][:, :1], reference.pooled(sparse, 2))
    else:
        assert torch.equal(encoded[0], torch.nn.functional.max_pool2d(sparse, 4))


@pytest.mark.parametrize("extra_skips", [False, True])
def test_multistack_outputs_follow_from_its_heads(extra_skips: bool) -> None:
    model = MultiStack(channels=5, extra_skips=extra_skips)
    heads: list[Tensor] = []
    handed: list[tuple[Tensor, ...]] = []
    for n in (1, 2, 3):
        getattr(model, f"depth_decoder{n}").register_forward_hook(lambda _m, _i, out: heads.append(out[0]))
        getattr(model, f"depth_encoder{n}").register_forward_hook(lambda _m, given, _o: handed.append(given[1:]))
    sparse, rgb = inputs()
    with torch.no_grad():
        out1, out2, out4 = model(sparse, rgb)
    r4, r2, r1 = heads
    p1 = reference.up2(r2 + reference.up2(r4))
    torch.testing.assert_close(out2, p1, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(out1, r1 + p1, rtol=1e-5, atol=1e-6)
    expected = torch.nn.functional.interpolate(r4, scale_factor=4, mode="bilinear", align_corners=True)
    torch.testing.assert_close(out4, expected)
    assert [len(part[0]) if part else 0 for part in handed] == [0, 3 if extra_skips else 1, 3 if extra_skips else 1]


def test_extra_skips_change_the_result_but_not_the_keys() -> None:
    torch.manual_seed(0)
    new = MultiStack(channels=4, extra_skips=True)
    old = MultiStack(channels=4, extra_skips=False)
    old.load_state_dict(new.state_dict())
    with torch.no_grad():
        difference = (new(*inputs())[0] - old(*inputs())[0]).abs().max()
    assert difference > 1e-4


def test_decoder_hands_on_features_before_the_last_skip() -> None:
    """The stage's output feature is dec1's, not dec1's plus s0; the head sees the sum."""
    model = Twise(channels=3)
    seen: dict[str, Tensor] = {}
    model.depth_decoder1.dec1.register_forward_hook(lambda _m, _i, out: seen.update(full=out))
    model.depth_encoder2.register_forward_hook(lambda _m, given, _o: seen.update(handed=given[1][0]))
    with torch.no_grad():
        model(*inputs())
    assert torch.equal(seen["full"], seen["handed"])


def test_skips_are_linear_features() -> None:
    """Nothing rectifies what encoders hand on: negative values survive."""
    with torch.no_grad():
        features = Twise(channels=8).rgb_encoder(inputs()[1])
    assert all(float(f.min()) < 0 for f in features)


@pytest.mark.parametrize("architecture", ["twise", "msg_chn", "selection"])
def test_without_any_sample_the_result_is_finite(architecture: str) -> None:
    model = build_model(default_spec(architecture)).eval()
    with torch.inference_mode():
        outputs = model(torch.zeros(1, 1, 64, 64), torch.rand(1, 3, 64, 64))
    assert all(torch.isfinite(out).all() for out in outputs)


def test_a_batch_is_its_images_one_by_one() -> None:
    model = Twise(channels=8)
    sparse, rgb = inputs()
    with torch.no_grad():
        together = model(sparse, rgb)
        apart = [model(sparse[i : i + 1], rgb[i : i + 1]) for i in range(2)]
    for scale in range(3):
        torch.testing.assert_close(together[scale], torch.cat([one[scale] for one in apart]), rtol=1e-5, atol=1e-5)


def test_published_initialisation() -> None:
    model = Twise(channels=32)
    for name, value in model.state_dict().items():
        if name.endswith("bias"):
            assert torch.equal(value, torch.full_like(value, 0.01))
        elif re.search(r"enc\d\.[13]", name):
            # Xavier-normal: variance 2 / (fan in + fan out)
            assert float(value.std()) == pytest.approx((2 / (32 * 9 * 2)) ** 0.5, rel=0.05)


def test_doubling_aligns_corners() -> None:
    x = torch.tensor([[[[0.0, 3.0]]]])
    assert upsample2(x)[0, 0, 0].tolist() == pytest.approx([0, 1, 2, 3])
