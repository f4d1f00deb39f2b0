"""The sparse-to-dense ResNet (18 or 34) of Ma, Cavalheiro, Karaman, "Self-Supervised Sparse-to-Dense" (ICRA 2019).

Layer names are those of the published state dictionary. Heads: one channel in metres, three for twin surfaces on the
same backbone (thesis Table 4.5), or N logits (Table 3.3).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from completion.models.blocks import require_multiple
from completion.models.resnet import block_counts, resnet_layer

SCALE = 100.0  # metres per unit of the published head
WIDTH = 64  # features of the published networks at full resolution
SHALLOWEST = 0.9  # metres; the published evaluation never predicts less


def _normalised(convolution: nn.Module, channels: int) -> nn.Sequential:
    return nn.Sequential(convolution, nn.BatchNorm2d(channels), nn.LeakyReLU(0.2))


def _input(inputs: int, outputs: int) -> nn.Sequential:
    return _normalised(nn.Conv2d(inputs, outputs, 3, padding=1, bias=False), outputs)


def _up(inputs: int, outputs: int, stride: int = 2) -> nn.Sequential:
    up = nn.ConvTranspose2d(inputs, outputs, 3, stride, padding=1, output_padding=stride - 1, bias=False)
    return _normalised(up, outputs)


def grey_levels(rgb: Tensor) -> Tensor:
    """RGB (B, 3, H, W) in 0..255 -> (B, 1, H, W) whole grey levels, as the reference reads them with Pillow.

    Pillow's conversion to L, ITU-R 601 in 16-bit fixed point; float32 holds every sum below 2^24 exactly.
    """
    red, green, blue = rgb.round().unsqueeze(2).unbind(1)
    return ((19595 * red + 38470 * green + 7471 * blue + 0x8000) / 0x10000).floor()


class Backbone(nn.Module):
    """(B, D, H, W) depth and (B, 3 or 1, H, W) image -> (B, heads, H, W), H and W multiples of 16.

    depth_channels  input channels of the depth branch (1, or the bins of Depth Coefficients)
    grey            the image is one grey channel (published "gd" models); both branches then have half the features
    width           features at full resolution (published: 64, a multiple of 4); every layer scales with it
    """

    levels_per_unit: float = 255.0  # grey levels per unit of the image as `forward` takes it

    def __init__(
        self, layers: int, heads: int, depth_channels: int = 1, grey: bool = False, width: int = WIDTH
    ) -> None:
        super().__init__()
        if width < 4 or width % 4:
            raise ValueError(f"width: expected a multiple of 4, got {width}")
        blocks = block_counts(layers)
        depth_width = width // 2 if grey else width // 4
        image_width = width - depth_width
        self.grey = grey
        self.conv1_d = _input(depth_channels, depth_width)
        self.conv1_img = _input(1 if grey else 3, image_width)
        w1, w2, w4, w8 = width, 2 * width, 4 * width, 8 * width
        self.conv2 = resnet_layer(w1, w1, blocks[0], 1)
        self.conv3 = resnet_layer(w1, w2, blocks[1], 2)
        self.conv4 = resnet_layer(w2, w4, blocks[2], 2)
        self.conv5 = resnet_layer(w4, w8, blocks[3], 2)
        self.conv6 = _normalised(nn.Conv2d(w8, w8, 3, stride=2, padding=1, bias=False), w8)
        self.convt5 = _up(w8, w4)
        self.convt4 = _up(w4 + w8, w2)
        self.convt3 = _up(w2 + w4, w1)
        self.convt2 = _up(w1 + w2, w1)
        self.convt1 = _up(w1 + w1, w1, stride=1)
        # A container of one, as published: the files name it convtf.0.
        self.convtf = nn.Sequential(nn.Conv2d(w1 + w1, heads, 1))
        self._initialise()

    def _initialise(self) -> None:
        """N(0, 0.001) for every convolution, as published for networks without pretrained weights; BN 1 and 0."""
        for layer in self.modules():
            if isinstance(layer, (nn.Conv2d, nn.ConvTranspose2d)):
                nn.init.normal_(layer.weight, std=1e-3)
                if layer.bias is not None:
                    nn.init.zeros_(layer.bias)

    def decode(self, depth: Tensor, image: Tensor) -> Tensor:
        """The head's raw values."""
        conv1 = torch.cat((self.conv1_d(depth), self.conv1_img(image)), 1)
        conv2 = self.conv2(conv1)
        conv3 = self.conv3(conv2)
        conv4 = self.conv4(conv3)
        conv5 = self.conv5(conv4)
        conv6 = self.conv6(conv5)
        y = torch.cat((self.convt5(conv6), conv5), 1)
        y = torch.cat((self.convt4(y), conv4), 1)
        y = torch.cat((self.convt3(y), conv3), 1)
        y = torch.cat((self.convt2(y), conv2), 1)
        y = torch.cat((self.convt1(y), conv1), 1)
        head: Tensor = self.convtf(y)
        return head

    def colours(self, rgb: Tensor) -> Tensor:
        """RGB (B, 3, H, W) as the image branch takes it: itself, or its grey level in the same unit."""
        return grey_levels(rgb * self.levels_per_unit) / self.levels_per_unit if self.grey else rgb


class SparseToDense(Backbone):
    """`forward(sparse in metres, rgb in 0..255) -> (B, 1, H, W)` metres.

    In training mode 100 times the head; in evaluation mode relu(100 y - 0.9) + 0.9, so never below 0.9 m.
    """

    levels_per_unit = 1.0

    def __init__(self, layers: int = 18, grey: bool = False, width: int = WIDTH) -> None:
        super().__init__(layers, heads=1, grey=grey, width=width)

    def forward(self, sparse: Tensor, rgb: Tensor) -> Tensor:
        require_multiple(sparse, rgb, 16)
        metres = SCALE * self.decode(sparse, self.colours(rgb))
        return metres if self.training else F.relu(metres - SHALLOWEST) + SHALLOWEST


class TwinSparseToDense(Backbone):
    """TWISE on ResNet: `forward(sparse / 80, rgb / 255) -> (out,)`, out (B, 3, H, W): surfaces / 80 m, sigma logit."""

    def __init__(self, layers: int = 18, grey: bool = False, width: int = WIDTH) -> None:
        super().__init__(layers, heads=3, grey=grey, width=width)

    def forward(self, sparse: Tensor, rgb: Tensor) -> tuple[Tensor]:
        require_multiple(sparse, rgb, 16)
        return (self.decode(sparse, self.colours(rgb)),)
