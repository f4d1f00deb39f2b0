"""Names and shapes of the published completion checkpoints, written down by hand: nothing here asks our networks."""

from __future__ import annotations

import torch
from torch import Tensor

Shapes = dict[str, tuple[int, ...]]


def _conv(name: str, out: int, inputs: int, size: int = 3) -> Shapes:
    return {f"{name}.weight": (out, inputs, size, size), f"{name}.bias": (out,)}


def hourglasses(channels: int, heads: int) -> Shapes:
    """TWISE (64 channels, 3 heads) and MSG-CHN (32 channels, 1 head): 92 tensors."""
    c = channels
    keys = _conv("rgb_encoder.init.0", c, 3) | _conv("rgb_encoder.init.2", c, c)
    for stage in ("enc1", "enc2", "enc3", "enc4"):
        keys |= _conv(f"rgb_encoder.{stage}.1", c, c) | _conv(f"rgb_encoder.{stage}.3", c, c)
    for number, inputs in (("1", 1), ("2", 2), ("3", 2)):
        encoder, decoder = f"depth_encoder{number}", f"depth_decoder{number}"
        keys |= _conv(f"{encoder}.init.0", c, inputs) | _conv(f"{encoder}.init.2", c, c)
        for part in (f"{encoder}.enc1", f"{encoder}.enc2", f"{decoder}.dec2", f"{decoder}.dec1"):
            keys |= _conv(f"{part}.1", c, c) | _conv(f"{part}.3", c, c)
        keys |= _conv(f"{decoder}.prdct.1", c, c) | _conv(f"{decoder}.prdct.3", heads, c)
    return keys


def _norm(name: str, channels: int) -> Shapes:
    parts = ("weight", "bias", "running_mean", "running_var")
    return {f"{name}.{part}": (channels,) for part in parts} | {f"{name}.num_batches_tracked": ()}


def _normalised(name: str, shape: tuple[int, ...], channels: int) -> Shapes:
    return {f"{name}.0.weight": shape} | _norm(f"{name}.1", channels)


def sparse_to_dense(blocks: tuple[int, ...] = (2, 2, 2, 2), grey: bool = False) -> Shapes:
    """Ma et al.: 164 tensors with 18 layers, 260 with 34. The last transposed convolution stands in a container."""
    depth, image, inputs = (32, 32, 1) if grey else (16, 48, 3)
    keys = _normalised("conv1_d", (depth, 1, 3, 3), depth)
    keys |= _normalised("conv1_img", (image, inputs, 3, 3), image)
    before = 64
    for number, (count, width) in enumerate(zip(blocks, (64, 128, 256, 512)), start=2):
        for block in range(count):
            name = f"conv{number}.{block}"
            keys |= {f"{name}.conv1.weight": (width, before, 3, 3), f"{name}.conv2.weight": (width, width, 3, 3)}
            keys |= _norm(f"{name}.bn1", width) | _norm(f"{name}.bn2", width)
            if before != width:
                keys |= _normalised(f"{name}.downsample", (width, before, 1, 1), width)
            before = width
    keys |= _normalised("conv6", (512, 512, 3, 3), 512)
    for name, inside, out in (
        ("convt5", 512, 256),
        ("convt4", 768, 128),
        ("convt3", 384, 64),
        ("convt2", 192, 64),
        ("convt1", 128, 64),
    ):
        keys |= _normalised(name, (inside, out, 3, 3), out)
    return keys | {"convtf.0.weight": (1, 128, 1, 1), "convtf.0.bias": (1,)}


def tensors(shapes: Shapes) -> dict[str, Tensor]:
    """Numbers of these shapes: small weights, unit variances, counters of zero."""
    torch.manual_seed(5)
    found = {}
    for name, shape in shapes.items():
        if name.endswith("num_batches_tracked"):
            found[name] = torch.tensor(0)
        elif name.endswith("running_var"):
            found[name] = torch.ones(shape)
        else:
            found[name] = torch.randn(shape) * 0.02
    return found
