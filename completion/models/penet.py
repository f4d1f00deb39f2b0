"""PENet (Hu et al., ICRA 2021): ENet refined by dilated, accelerated convolutional spatial propagation (DA-CSPN++).

A pixel hands its value to its neighbours with its own weights, so those arriving somewhere need not sum to one; the
centre tap always reads the map from before the level. Kernels of 3, 5 and 7 run side by side.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from auglidar_base.errors import SettingsError
from completion.models.enet import WIDTH, BackboneOutput, ENet, initialise
from completion.models.geometric import pool_nearest

KERNELS = (3, 5, 7)
# Iterations of one level, by the largest dilation; dilation 1 has one level, 2 has two, 4 has three.
ITERATIONS = {1: 12, 2: 6, 4: 4}
ITERATION_STEP = 3


def arriving_weights(guide: Tensor, kept: Tensor | None = None) -> Tensor:
    """Weights by the pixel that sends -> by the pixel that receives.

    guide  (B, k^2 - 1, H, W) raw, neighbours in reading order
    kept   (B, 1, H, W) scales all that a pixel sends, its own share included; None: 1

    Returns (B, k^2, H, W): channel i weighs the pixel at tap i, 0 when that lies outside the image.
    """
    total = guide.abs().sum(dim=1, keepdim=True)
    guide = guide / torch.where(total > 0, total, torch.ones_like(total))
    middle = guide.shape[1] // 2
    centre = 1 - guide.sum(dim=1, keepdim=True)
    weights = torch.cat([guide[:, :middle], centre, guide[:, middle:]], dim=1)
    return shift_to_receiver(weights if kept is None else kept * weights)


def shift_to_receiver(weights: Tensor) -> Tensor:
    """(B, k^2, H, W): channel i of the result at p is channel k^2 - 1 - i at p + tap i."""
    count, (height, width) = weights.shape[1], weights.shape[-2:]
    kernel = round(count**0.5)
    padded = F.pad(weights, (kernel // 2,) * 4)
    taps = (divmod(i, kernel) for i in range(count))
    shifted = [padded[:, count - 1 - i, y : y + height, x : x + width] for i, (y, x) in enumerate(taps)]
    return torch.stack(shifted, dim=1)


def propagate(depth: Tensor, start: Tensor, weights: Tensor, dilation: int) -> Tensor:
    """One step: the sum over the taps of weight x depth there; the centre tap reads `start`. Outside is 0.

    depth, start  (B, 1, H, W)
    weights       (B, k^2, H, W) as `arriving_weights`
    """
    count, (height, width) = weights.shape[1], weights.shape[-2:]
    kernel, middle = round(count**0.5), count // 2
    reach = kernel // 2 * dilation
    total = weights[:, middle, None] * start
    if weights.requires_grad and torch.is_grad_enabled():
        # Few large operations: the gradient of one slice after the other costs far more than the memory of this.
        taps = F.unfold(depth, kernel, dilation, reach).view(len(depth), count, height, width)
        for part in (slice(0, middle), slice(middle + 1, count)):
            total = total + (weights[:, part] * taps[:, part]).sum(dim=1, keepdim=True)
        return total
    padded = F.pad(depth, (reach,) * 4)
    for tap in range(count):
        if tap != middle:
            y, x = (dilation * part for part in divmod(tap, kernel))
            total = torch.addcmul(total, weights[:, tap, None], padded[:, :, y : y + height, x : x + width])
    return total


class Guide(nn.Module):
    """The convolution that predicts a kernel's raw weights."""

    def __init__(self, inputs: int, kernel: int) -> None:
        super().__init__()
        self.generate = _head(inputs, kernel**2 - 1)

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, k^2 - 1, H, W)."""
        raw: Tensor = self.generate(features)
        return raw


def _head(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, 1, 1, bias=False), nn.BatchNorm2d(outputs))


def _enlarge(values: Tensor, factor: int) -> Tensor:
    return values if factor == 1 else F.interpolate(values, scale_factor=factor, mode="nearest")


class PENet(nn.Module):
    """The network; names of its layers as published, without the training class' attention that has no effect.

    dilation  largest of the levels: 1 (C1), 2 (C2, the published model) or 4 (C4)
    others    see `enet.ENet`
    """

    def __init__(
        self,
        dilation: int = 2,
        encoding: str = "xyz",
        width: int = WIDTH,
        crop: str = "bottom",
        camera: str = "published",
    ) -> None:
        super().__init__()
        if dilation not in ITERATIONS:
            raise SettingsError(f"dilation: expected one of 1, 2, 4, got {dilation!r}")
        self.dilation, self.crop, self.camera = dilation, crop, camera
        self.backbone = ENet(encoding, width, crop, camera)
        refinement = nn.ModuleDict()
        for level in range(dilation.bit_length()):
            inputs, end = 2 * width * 2**level, f"_s{level + 1}" if level else ""
            refinement[f"kernel_conf_layer{end}"] = _head(inputs, len(KERNELS))
            refinement[f"mask_layer{end}"] = _head(inputs, len(KERNELS) if dilation == 1 else 1)
            if dilation == 4:
                refinement[f"prop_mask_layer{end}"] = _head(inputs, 1)
            if dilation == 1:
                refinement["iter_conf_layer"] = _head(inputs, len(KERNELS) * ITERATIONS[1] // ITERATION_STEP)
            for kernel in KERNELS:
                refinement[f"iter_guide_layer{kernel}{end}"] = Guide(inputs, kernel)
        initialise(refinement)
        for name, layer in refinement.items():
            self.add_module(name, layer)

    def forward(
        self, sparse: Tensor, rgb: Tensor, position: Tensor | None = None, K: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """Refined depth (B, 1, H, W) in metres, not clamped; inputs as `enet.ENet.backbone`."""
        found: BackboneOutput = self.backbone.backbone(sparse, rgb, position, K)
        if self.dilation == 1:
            return (self._single_level(found, sparse),)
        pooled = [sparse]
        for _ in range(self.dilation.bit_length() - 1):
            pooled.append(pool_nearest(pooled[-1]))
        depth = found.depth
        for level in range(len(pooled) - 1, -1, -1):
            depth = self._level(level, depth, found.features[level], pooled[level])
        return (depth,)

    def _head(self, name: str, level: int, features: Tensor) -> Tensor:
        result: Tensor = self.get_submodule(f"{name}_s{level + 1}" if level else name)(features)
        return result

    def _level(self, level: int, start: Tensor, features: Tensor, sparse: Tensor) -> Tensor:
        """The iterations of one level on the full-size map, with weights and measured depth of its own size."""
        factor = 2**level
        mask = _enlarge(torch.sigmoid(self._head("mask_layer", level, features)) * (sparse > 0), factor)
        shares = _enlarge(torch.softmax(self._head("kernel_conf_layer", level, features), dim=1), factor)
        measured = _enlarge(sparse, factor)
        total = torch.zeros_like(start)
        for number, kernel in enumerate(KERNELS):
            weights = _enlarge(self._weights(level, kernel, features), factor)
            depth = start
            for _ in range(ITERATIONS[self.dilation]):
                depth = propagate(depth, start, weights, factor)
                depth = mask * measured + (1 - mask) * depth
            total = total + shares[:, number, None] * depth
        return total

    def _weights(self, level: int, kernel: int, features: Tensor) -> Tensor:
        guide = self._head(f"iter_guide_layer{kernel}", level, features)
        kept = torch.sigmoid(self._head("prop_mask_layer", level, features)) if self.dilation == 4 else None
        return arriving_weights(guide, kept)

    def _single_level(self, found: BackboneOutput, sparse: Tensor) -> Tensor:
        """Dilation 1: a mask for each kernel; every third iteration counts, by confidence."""
        features, start = found.features[0], found.depth
        masks = torch.sigmoid(self._head("mask_layer", 0, features)) * (sparse > 0)
        shares = torch.softmax(self._head("kernel_conf_layer", 0, features), dim=1)
        moments = ITERATIONS[1] // ITERATION_STEP
        parts = self._head("iter_conf_layer", 0, features).split(moments, dim=1)
        total = torch.zeros_like(start)
        for number, kernel in enumerate(KERNELS):
            weights = self._weights(0, kernel, features)
            mask, trust = masks[:, number, None], torch.softmax(parts[number], dim=1)
            depth = start
            for step in range(1, ITERATIONS[1] + 1):
                depth = propagate(depth, start, weights, 1)
                depth = mask * sparse + (1 - mask) * depth
                if step % ITERATION_STEP == 0:
                    total = total + shares[:, number, None] * trust[:, step // ITERATION_STEP - 1, None] * depth
        return total
