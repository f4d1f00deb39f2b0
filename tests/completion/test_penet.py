"""ENet and PENet: sizes as published, geometric maps by hand, propagation against an obvious twin, a window's place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from completion.infer import network_completer
from completion.inputs import scale_rgb
from completion.models import build_model, default_spec
from completion.models.enet import ENet
from completion.models.geometric import (
    GeometricBlock,
    bottom_centre,
    geometric_maps,
    pool_nearest,
    position_map,
    published_intrinsics,
)
from completion.models.penet import PENet, arriving_weights, propagate, shift_to_receiver
from completion.samples import Augmentation, placed_crop
from completion.train import TrainSettings, train
from completion.training_loss import LossSettings, training_loss
from completion.windows import batch_view, window_corner, window_intrinsics
from tests.completion.scenes import street
from tests.reference.completion_propagation import scattered, shifted_by_kernels, smallest_valid


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Networks of a few channels: more threads only wait for each other on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def count(model: torch.nn.Module) -> int:
    return sum(p.numel() for p in model.parameters())


@pytest.mark.parametrize(
    ("encoding", "parameters"), [("xyz", 131_762_888), ("std", 131_322_440), ("z", 131_469_256), ("uv", 131_616_072)]
)
def test_enet_is_as_large_as_published(encoding: str, parameters: int) -> None:
    with torch.device("meta"):
        model = ENet(encoding)
    assert (count(model), len(model.state_dict())) == (parameters, 384)


# Without the three constant tensors encoder3, encoder5, encoder7 of the published class.
@pytest.mark.parametrize(
    ("dilation", "parameters", "tensors"), [(1, 131_819_532, 420), (2, 131_908_376, 444), (4, 132_106_118, 492)]
)
def test_penet_is_as_large_as_published(dilation: int, parameters: int, tensors: int) -> None:
    with torch.device("meta"):
        model = PENet(dilation)
    assert (count(model), len(model.state_dict())) == (parameters, tensors)


def test_pooling_takes_the_nearest_of_a_block() -> None:
    rng = np.random.default_rng(0)
    depth = (rng.uniform(1, 80, (12, 16)) * (rng.random((12, 16)) < 0.3)).astype(np.float32)
    found = pool_nearest(torch.from_numpy(depth)[None, None])[0, 0].numpy()
    np.testing.assert_array_equal(found, smallest_valid(depth))
    assert (found == 0).any()


def test_geometric_maps_by_hand() -> None:
    sparse = torch.zeros(1, 1, 352, 1216)
    sparse[0, 0, 351, 1215], sparse[0, 0, 0, 0] = 20.0, 10.0
    position = position_map([bottom_centre(352, 1216)], 352, 1216)
    assert position[0, :, 0, 0].tolist() == [-1, -1]
    assert position[0, :, 351, 1215].tolist() == [1, 1]
    K = published_intrinsics()[None]
    maps = geometric_maps(sparse, position, K, "xyz")
    # (v_s + 1) / 2 is 0 .. 1 at full size, so that the last pixel lies at 352, 1216.
    expected = [20 * (352 - 161.354) / 721.5377, 20 * (1216 - 596.5593) / 721.5377, 20.0]
    torch.testing.assert_close(maps[0][0, :, 351, 1215], torch.tensor(expected))
    torch.testing.assert_close(maps[0][0, :, 0, 0], torch.tensor([-1613.54 / 721.5377, -5965.593 / 721.5377, 10.0]))
    assert maps[0].count_nonzero() == 6
    # Half size: mean position of the block, half the extent, intrinsics unchanged.
    row, column = 0.5 * 176 * (1 - 1 / 351 + 1), 0.5 * 608 * (1 - 1 / 1215 + 1)
    expected = [20 * (row - 161.354) / 721.5377, 20 * (column - 596.5593) / 721.5377, 20.0]
    torch.testing.assert_close(maps[1][0, :, -1, -1], torch.tensor(expected))
    assert [tuple(m.shape[1:]) for m in maps][-1] == (3, 11, 38)
    row_first = geometric_maps(sparse, position, K, "uv")[0]
    assert torch.equal(row_first, position.flip(1))
    assert torch.equal(geometric_maps(sparse, position, K, "z")[0], sparse)
    assert geometric_maps(sparse, position, K, "std")[2].shape == (1, 0, 88, 304)


def test_a_part_of_the_window_knows_its_place() -> None:
    full = position_map([(0, 0)], 352, 1216)
    part = position_map([(100, 400), (288, 1184)], 64, 32)
    torch.testing.assert_close(part[0], full[0, :, 100:164, 400:432])
    torch.testing.assert_close(part[1], full[0, :, 288:352, 1184:1216])


def test_the_block_sees_geometry_behind_its_input_and_before_its_inner_map() -> None:
    block = GeometricBlock(2, 2, 1, 1).eval()
    torch.nn.init.zeros_(block.conv1.weight)
    torch.nn.init.zeros_(block.conv2.weight)
    x, before, after = torch.ones(1, 2, 4, 4), torch.full((1, 1, 4, 4), 3.0), torch.full((1, 1, 4, 4), 5.0)
    with torch.no_grad():
        block.conv1.weight[0, 2, 1, 1] = 1  # inner channel 0 = the map before = 3
        block.conv2.weight[0, 0, 1, 1] = 1  # channel 0 of the sum = the map after = 5
        block.conv2.weight[1, 1, 1, 1] = 1  # channel 1 of the sum = inner channel 0
        found = block(x, before, after)
    torch.testing.assert_close(found[0, :, 1, 1], torch.tensor([6.0, 4.0]), atol=1e-3, rtol=0)


@pytest.mark.parametrize("kernel", [3, 5, 7])
def test_pixels_hand_on_their_values_with_their_own_weights(kernel: int) -> None:
    rng = np.random.default_rng(kernel)
    depth, start = rng.uniform(1, 50, (2, 9, 11))
    guide = rng.normal(size=(kernel**2 - 1, 9, 11))
    weights = arriving_weights(torch.from_numpy(guide)[None])
    found = propagate(*(torch.from_numpy(part)[None, None] for part in (depth, start)), weights, 1)
    np.testing.assert_allclose(found[0, 0].numpy(), scattered(depth, start, guide), atol=1e-9)
    learnt = propagate(
        *(torch.from_numpy(part)[None, None] for part in (depth, start)), weights.clone().requires_grad_(), 1
    )
    torch.testing.assert_close(learnt.detach(), found)


@pytest.mark.parametrize("kernel", [3, 5])
def test_the_shift_equals_the_published_kernels(kernel: int) -> None:
    torch.manual_seed(0)
    weights = torch.randn(2, kernel**2, 8, 10)
    assert torch.equal(shift_to_receiver(weights), shifted_by_kernels(weights))


def test_constant_maps_stay_inside_and_leak_at_the_border() -> None:
    weights = arriving_weights(torch.linspace(-1, 3, 24).view(1, 24, 1, 1).expand(1, 24, 10, 12))
    constant = torch.full((1, 1, 10, 12), 7.0)
    found = propagate(constant, constant, weights, 1)
    torch.testing.assert_close(found[..., 2:-2, 2:-2], constant[..., 2:-2, 2:-2])
    assert (found[..., 0, :] - 7).abs().min() > 0.01


def test_dilated_taps_equal_the_four_sub_lattices() -> None:
    torch.manual_seed(1)
    depth, start = torch.rand(2, 1, 1, 16, 20)
    weights = arriving_weights(torch.randn(1, 48, 8, 10))
    found = propagate(depth, start, weights.repeat_interleave(2, 2).repeat_interleave(2, 3), 2)
    for y in (0, 1):
        for x in (0, 1):
            part = propagate(depth[..., y::2, x::2], start[..., y::2, x::2], weights, 1)
            torch.testing.assert_close(found[..., y::2, x::2], part)


@pytest.mark.parametrize("dilation", [1, 2, 4])
def test_a_batch_equals_its_parts_and_measured_depth_pulls(dilation: int) -> None:
    torch.manual_seed(2)
    model = PENet(dilation, width=2).double().eval()
    sparse = torch.rand(2, 1, 32, 64).double() * 50 * (torch.rand(2, 1, 32, 64) > 0.9)
    rgb = torch.rand(2, 3, 32, 64).double() * 255
    with torch.no_grad():
        both = model(sparse, rgb)[0]
        singles = torch.cat([model(sparse[i : i + 1], rgb[i : i + 1])[0] for i in (0, 1)])
        torch.testing.assert_close(both, singles, rtol=1e-4, atol=1e-4)
        for name, layer in model.named_modules():
            if name.startswith("mask_layer") and name.endswith(".1"):
                layer.weight.zero_()
                layer.bias.fill_(50.0)
        pulled = model(sparse, rgb)[0]
    # A mask of 1 puts the measured depth back after every iteration.
    seen = sparse > 0
    torch.testing.assert_close(pulled[seen], sparse[seen], rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match="multiples of 32, got 33 x 64"):
        model(torch.zeros(1, 1, 33, 64), torch.zeros(1, 3, 33, 64))


def test_wrong_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="dilation: expected one of 1, 2, 4, got 3"):
        PENet(3, width=1)
    with pytest.raises(ValueError, match="encoding: expected one of std, z, uv, xyz, got 'xy'"):
        ENet("xy", width=1)
    with pytest.raises(ValueError, match="crop: expected one of bottom, top_left"):
        ENet(crop="centre", width=1)


@pytest.mark.parametrize(
    ("crop", "rows", "columns"), [("bottom", (23, 375), (13, 1229)), ("top_left", (0, 352), (0, 1216))]
)
def test_the_window_of_a_kitti_frame(crop: str, rows: tuple[int, int], columns: tuple[int, int]) -> None:
    torch.manual_seed(3)
    spec = default_spec("enet", width=1, crop=crop)
    model = build_model(spec).eval()
    frame = street(0, 375, 1242)
    found = network_completer(model, spec, decoding="depth").complete(frame.sparse, frame.image).depth
    part = slice(*rows), slice(*columns)
    sparse, image = torch.tensor(frame.sparse[part])[None, None], torch.tensor(frame.image[part]).permute(2, 0, 1)[None]
    with torch.no_grad():
        expected = model(sparse, image.float(), position_map([(0, 0)], 352, 1216), published_intrinsics()[None])[0]
    np.testing.assert_allclose(found[part], expected[0, 0].clamp(min=0).numpy(), rtol=1e-4, atol=1e-4)
    assert found.any()
    found[part] = 0
    assert not found.any()


def test_the_frames_own_camera_is_asked_for() -> None:
    spec = default_spec("penet", width=1, camera="frame")
    completer = network_completer(build_model(spec), spec, decoding="depth")
    frame = street(0, 40, 72)
    with pytest.raises(ValueError, match=r"K: this network was set up with camera=frame, .*pass K"):
        completer.complete(frame.sparse, frame.image)
    with pytest.raises(ValueError, match="K: this network"):
        batch_view(spec, torch.zeros(1, 1, 32, 32), torch.zeros(1, 2), torch.full((1, 3, 3), torch.nan))
    K = np.array([[700.0, 0, 600], [0, 710.0, 170], [0, 0, 1]])
    assert completer.complete(frame.sparse, frame.image, K).depth.shape == (40, 72)
    corner = window_corner((375, 1242), "bottom")
    assert corner == (23, 13)
    assert window_intrinsics(K, corner, "frame").tolist() == [[700, 0, 587], [0, 710, 147], [0, 0, 1]]
    assert window_intrinsics(K, corner, "published")[1, 2] == pytest.approx(161.354)
    assert window_corner((40, 72), "bottom") == (-312, -572)


@pytest.mark.parametrize(("architecture", "width", "steps"), [("enet", 4, 40), ("penet", 2, 15)])
def test_it_overfits_two_frames(architecture: str, width: int, steps: int) -> None:
    torch.manual_seed(0)
    spec = default_spec(architecture, width=width)
    model = build_model(spec)
    frames = [street(seed, 32, 64, 6) for seed in (1, 2)]
    sparse, target = (
        torch.from_numpy(np.stack([getattr(f, name) for f in frames]))[:, None] for name in ("sparse", "target")
    )
    rgb = scale_rgb(torch.from_numpy(np.stack([f.image for f in frames])).permute(0, 3, 1, 2), spec.rgb)
    backbone = model.get_submodule("backbone") if architecture == "penet" else model
    with torch.no_grad():  # metres from the start: from 0 they would take some hundred steps
        for head in (backbone.rgb_decoder_output, backbone.decoder_layer6):
            head[1].weight[0] = 10.0
            head[1].bias[0] = 25.0
    optimiser = torch.optim.Adam(model.parameters(), lr=0.05, betas=(0.9, 0.99))
    losses = []
    for _ in range(steps):
        optimiser.zero_grad()
        parts = training_loss(model(sparse, rgb), sparse, target, spec, LossSettings("l2"), (0.6, 0.2, 0.2), 0.0)
        parts["loss"].backward()
        optimiser.step()
        losses.append(float(parts["loss"].detach()))
    assert losses[0] > 100
    assert losses[-1] < losses[0] / 5
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in model.parameters())


def test_a_continued_training_gives_the_same_bits(tmp_path: Path) -> None:
    spec = default_spec("penet", width=1, camera="frame")
    settings = TrainSettings(
        spec, LossSettings("l2"), Augmentation((32, 64)), steps=3, batch_size=1, accumulate=1, save_every=1
    )
    K = np.array([[300.0, 0, 48], [0, 300, 24], [0, 0, 1]])
    frames = [replace(street(seed, 48, 96), K=K) for seed in (1, 2)]
    train(settings, frames, tmp_path / "whole")
    for _ in range(3):
        train(settings, frames, tmp_path / "parts", seconds=0)
    states = [(tmp_path / name / "last.safetensors").read_bytes() for name in ("whole", "parts")]
    assert states[0] == states[1]
    with pytest.raises(ValueError, match="K: this network was set up with camera=frame"):
        train(settings, [street(1, 48, 96)], tmp_path / "without")


def test_crops_carry_their_place_and_camera() -> None:
    K = np.array([[700.0, 0, 600], [0, 710.0, 170], [0, 0, 1]])
    frame = replace(street(3, 375, 1242), K=K)
    crop = placed_crop(frame, Augmentation((352, 1216), bottom=True, flip=1.0), np.random.default_rng(0))
    assert crop.place[0] == 0
    assert -13 <= crop.place[1] <= 13
    assert crop.K[:2, 2].tolist() == [587, 147]
    left = crop.place[1] + 13
    assert np.array_equal(crop.target[:, ::-1], frame.target[23:, left : left + 1216])
    assert np.isnan(placed_crop(street(3, 64, 64), Augmentation(), np.random.default_rng(0)).K).all()
