"""ENet, the backbone of PENet (Hu et al., ICRA 2021): a colour branch and a depth branch, fused by confidence."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from auglidar_base.errors import SettingsError
from completion.models.geometric import (
    ENCODINGS,
    GeometricBlock,
    bottom_centre,
    geometric_maps,
    position_map,
    published_intrinsics,
)

WIDTH = 32
CROPS = ("bottom", "top_left")
CAMERAS = ("published", "frame")
MULTIPLE = 32


class BackboneOutput(NamedTuple):
    """Three depths (B, 1, H, W) in metres, and features (B, 2 w, H, W), (B, 4 w, H/2, W/2), (B, 8 w, H/4, W/4)."""

    depth: Tensor
    colour_depth: Tensor
    sparse_depth: Tensor
    features: tuple[Tensor, Tensor, Tensor]


def _conv(inputs: int, outputs: int, kernel: int) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, kernel, 1, kernel // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU())


def _deconv(inputs: int, outputs: int, kernel: int = 5, stride: int = 2) -> nn.Sequential:
    up = nn.ConvTranspose2d(inputs, outputs, kernel, stride, kernel // 2, stride - 1, bias=False)
    return nn.Sequential(up, nn.BatchNorm2d(outputs), nn.ReLU())


def initialise(network: nn.Module) -> None:
    """Published initialisation: normal weights of variance 2 / (k^2 x outputs), of inputs for transposed ones."""
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            fan = layer.in_channels if isinstance(layer, nn.ConvTranspose2d) else layer.out_channels
            nn.init.normal_(layer.weight, 0.0, math.sqrt(2 / (layer.kernel_size[0] * layer.kernel_size[1] * fan)))


class ENet(nn.Module):
    """The network; names of its layers as published.

    encoding  what the geometric convolutions see: "xyz" (published), "uv", "z", or "std" for nothing
    width     channels at full size (32)
    crop      where the window of 352 x 1216 lies in a frame, see `completion.windows`
    camera    whose intrinsics a completer passes: "published" (one constant) or the "frame"'s own
    """

    def __init__(
        self, encoding: str = "xyz", width: int = WIDTH, crop: str = "bottom", camera: str = "published"
    ) -> None:
        super().__init__()
        for name, value, known in (
            ("encoding", encoding, tuple(ENCODINGS)),
            ("crop", crop, CROPS),
            ("camera", camera, CAMERAS),
        ):
            if value not in known:
                raise SettingsError(f"{name}: expected one of {', '.join(known)}, got {value!r}")
        self.encoding, self.crop, self.camera = encoding, crop, camera
        extra = ENCODINGS[encoding]
        sizes = [width * 2**power for power in range(6)]
        self.rgb_conv_init = _conv(4, width, 5)
        self.depth_conv_init = _conv(2, width, 5)
        for power in range(1, 6):
            before, after = sizes[power - 1], sizes[power]
            joined = before if power == 1 else 2 * before
            number = 2 * power - 1
            self.add_module(f"rgb_encoder_layer{number}", GeometricBlock(before, after, 2, extra))
            self.add_module(f"rgb_encoder_layer{number + 1}", GeometricBlock(after, after, 1, extra))
            self.add_module(f"depth_layer{number}", GeometricBlock(joined, after, 2, extra))
            self.add_module(f"depth_layer{number + 1}", GeometricBlock(after, after, 1, extra))
            self.add_module(f"rgb_decoder_layer{number - 1}", _deconv(after, before))
            self.add_module(f"decoder_layer{6 - power}", _deconv(after, before))
        self.rgb_decoder_output = _deconv(width, 2, 3, 1)
        self.decoder_layer6 = _conv(width, 2, 3)
        initialise(self)

    def forward(
        self, sparse: Tensor, rgb: Tensor, position: Tensor | None = None, K: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """Fused depth, depth of the colour branch, depth of the depth branch, (B, 1, H, W) metres; see `backbone`."""
        found = self.backbone(sparse, rgb, position, K)
        return found.depth, found.colour_depth, found.sparse_depth

    def backbone(
        self, sparse: Tensor, rgb: Tensor, position: Tensor | None = None, K: Tensor | None = None
    ) -> BackboneOutput:
        """Depths and features.

        sparse    (B, 1, H, W) metres, 0 = none; H and W multiples of 32
        rgb       (B, 3, H, W) in 0..255
        position  (B, 2, H, W) as `geometric.position_map`; None: the input lies bottom centre in the window
        K         (B, 3, 3) in pixels of the window; None: the published constant
        """
        height, width = sparse.shape[-2:]
        if height % MULTIPLE or width % MULTIPLE:
            raise ValueError(f"height and width must be multiples of {MULTIPLE}, got {height} x {width}")
        if position is None:
            place = torch.tensor([bottom_centre(height, width)], device=sparse.device).expand(len(sparse), 2)
            position = position_map(place, height, width)
        if K is None:
            K = published_intrinsics().to(sparse.device).expand(len(sparse), 3, 3)
        geometry = geometric_maps(sparse, position, K, self.encoding)
        coloured = self.rgb_conv_init(torch.cat([rgb, sparse], dim=1))
        encoded = self._encode("rgb_encoder_layer", coloured, geometry, [])
        decoded = encoded[5]
        ups = []
        for power in range(5, 0, -1):
            decoded = self.get_submodule(f"rgb_decoder_layer{2 * power - 2}")(decoded) + encoded[power - 1]
            ups.append(decoded)
        colour_depth, colour_confidence = self.rgb_decoder_output(decoded).split(1, dim=1)

        start = self.depth_conv_init(torch.cat([sparse, colour_depth], dim=1))
        layers = self._encode("depth_layer", start, geometry, ups[::-1])
        fused = encoded[5] + layers[5]
        finals = []
        for number in range(1, 6):
            fused = self.get_submodule(f"decoder_layer{number}")(fused)
            if number < 5:
                fused = fused + layers[5 - number]
            finals.append(fused)
        sparse_depth, sparse_confidence = self.decoder_layer6(fused).split(1, dim=1)

        share = torch.softmax(torch.cat([colour_confidence, sparse_confidence], dim=1), dim=1)
        depth = share[:, :1] * colour_depth + share[:, 1:] * sparse_depth
        first, second, third = (torch.cat([ups[i], finals[i]], dim=1) for i in (4, 3, 2))
        return BackboneOutput(depth, colour_depth, sparse_depth, (first, second, third))

    def _encode(self, name: str, start: Tensor, geometry: list[Tensor], joined: list[Tensor]) -> list[Tensor]:
        """Features at 1, 1/2, ..., 1/32; `joined`, from full size on, go before those of 1/2 to 1/16."""
        found = [start]
        for power in range(1, 6):
            features = found[-1]
            if joined and power > 1:
                features = torch.cat([joined[power - 1], features], dim=1)
            before, after = geometry[power - 1], geometry[power]
            features = self.get_submodule(f"{name}{2 * power - 1}")(features, before, after)
            found.append(self.get_submodule(f"{name}{2 * power}")(features, after, after))
        return found
