"""The kernels of our own against torch: single convolutions, whole networks of the published width, any size."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from completion.cpu import strided, winograd
from completion.cpu.hourglass import hourglass_forward
from completion.cpu.patches import COARSER, LINEAR, NOTHING, RECTIFIED, SAME, Added, Layer, Summands
from completion.cpu.pixel_unet import PixelUNetKernels
from completion.models import build_model, default_spec
from tests.completion.scenes import street


def maps(*shape: int, seed: int = 0) -> torch.Tensor:
    """(1, C, H, W) whose channels lie together."""
    return torch.randn(1, *shape, generator=torch.manual_seed(seed)).contiguous(memory_format=torch.channels_last)


def last(x: torch.Tensor) -> np.ndarray:
    return x[0].permute(1, 2, 0).contiguous().numpy()


@pytest.mark.parametrize(("inputs", "outputs", "size"), [(64, 64, (37, 150)), (40, 24, (16, 96)), (3, 5, (1, 1))])
def test_convolution_is_torchs(inputs: int, outputs: int, size: tuple[int, int]) -> None:
    parts = [maps(inputs, *size, seed=seed) for seed in range(3)]
    weight, bias = torch.randn(outputs, inputs, 3, 3) / (3 * inputs**0.5), torch.randn(outputs)
    coarse = maps(outputs, (size[0] + 1) // 2, (size[1] + 1) // 2)
    same = maps(outputs, *size, seed=9)
    enlarged = F.interpolate(coarse, size=size, mode="bilinear", align_corners=True)
    prepared = Layer(winograd.winograd_weights(weight), bias.numpy())
    for summands in (1, 2, 3):
        for least, kind, other in ((RECTIFIED, COARSER, coarse), (LINEAR, SAME, same), (LINEAR, NOTHING, same)):
            x = sum(parts[:summands], torch.zeros(()))
            plain = F.conv2d((F.relu(x) if least == 0 else x).double(), weight.double(), bias.double(), padding=1)
            expected = plain + {COARSER: enlarged, SAME: same, NOTHING: torch.zeros(())}[kind]
            found = np.full((*size, outputs), np.nan, np.float32)
            given = Summands.of(tuple(map(last, parts[:summands])), least)
            common = given, prepared, Added(last(other), kind), found
            middle = (size[0] + 3) // 8
            winograd.convolve(0, middle, *common)
            winograd.convolve(middle, (size[0] + 3) // 4, *common)
            assert np.abs(found - last(expected)).max() < 2e-5


def test_strides_and_heads_are_torchs() -> None:
    x, weight, bias = maps(32, 10, 70), torch.randn(32, 32, 3, 3) / 17, torch.randn(32)
    rectified = F.relu(x)
    half = np.empty((5, 35, 32), np.float32)
    strided.halve(0, 5, last(x), Layer(strided.tap_weights(weight), bias.numpy()), half)
    assert np.abs(half - last(F.conv2d(rectified, weight, bias, stride=2, padding=1))).max() < 1e-5

    twice = np.empty((20, 140, 32), np.float32)
    prepared = Layer(strided.tap_weights(weight, transposed=True), bias.numpy())
    strided.double(0, 10, Summands.of((last(x),)), prepared, twice)
    expected = F.conv_transpose2d(rectified, weight, bias, stride=2, padding=1, output_padding=1)
    assert np.abs(twice - last(expected)).max() < 1e-5

    planes = np.empty((3, 10, 70), np.float32)
    head = Layer(strided.head_weights(weight[:3]), bias[:3].numpy())
    for rows in ((0, 4), (4, 10)):
        strided.convolve_head(*rows, last(x), head, planes)
    assert np.abs(planes - F.conv2d(rectified, weight[:3], bias[:3], padding=1)[0].numpy()).max() < 1e-5


@pytest.mark.parametrize(
    ("architecture", "arguments"),
    [("twise", {}), ("twise", {"extra_skips": True, "channels": 16}), ("msg_chn", {"pooling": "max"})],
)
@pytest.mark.parametrize("threads", [1, 2])
def test_hourglasses_are_torchs(architecture: str, arguments: dict[str, object], threads: int) -> None:
    """Depths of a street: within 1e-4 of the largest, which is also within a millimetre."""
    torch.manual_seed(3)
    spec = default_spec(architecture, init="he", **arguments)
    model = build_model(spec).eval()
    frames = [street(seed, 64, 96) for seed in (1, 2)]
    sparse = torch.from_numpy(np.stack([frame.sparse for frame in frames]))[:, None] / spec.depth_unit
    rgb = torch.from_numpy(np.stack([frame.image for frame in frames])).permute(0, 3, 1, 2) / 255
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        run = hourglass_forward(model)  # type: ignore[arg-type]
    finally:
        torch.set_num_threads(before)
    with torch.inference_mode():
        expected = model(sparse, rgb)[0]
        found = run(sparse, rgb)
        again = run(sparse, rgb)
    metres = 80 / float(expected.abs().max())
    assert torch.equal(found, again)
    assert metres * float((found - expected).abs().max()) < 1e-3


def test_pixel_unet_is_torchs() -> None:
    torch.manual_seed(0)
    model = build_model(default_spec("selection", width=16)).eval()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    kernels = PixelUNetKernels(model.network)  # type: ignore[arg-type]
    x = maps(40, 32, 48)
    with torch.inference_mode():
        expected = model.network.at_half(x)  # type: ignore[operator, union-attr]
        found = kernels(x)
    assert float((found - expected).abs().max()) < 1e-4 * float(expected.abs().max())
