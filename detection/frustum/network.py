"""The three networks of Frustum PointNet v1: segmentation, centre (T-Net) and amodal box.

Parameter names are those of the widely used PyTorch port (InsSeg, STN, est). The original (TensorFlow) and the port
compute different things with equal shapes, so a network knows its `variant`.
Source: Qi et al. 2018, sections 4.2, 4.3 and supplementary A; published code of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import cast

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from auglidar_base.errors import SettingsError
from detection.frustum.coding import BIN, CLASSES, CLUSTERS, HEADING_BINS, SIZE_TABLE
from detection.models.layers import PointwiseWeight, RowBatchNorm, maximum, normalise_relu, project_relu

OBJECT_POINTS = 512
BOX_NUMBERS = 3 + 2 * HEADING_BINS + 4 * len(CLUSTERS)


@dataclass(frozen=True)
class Variant:
    """Where the original and the PyTorch port differ.

    skip        layer (1-based) whose 64 features join the global ones in the segmentation
    eps         of every batch normalisation
    empty_zero  a frustum without object points feeds zeros; otherwise its first point, as often as needed
    first_centre_target   what the first centre is compared with in the loss: "truth", or "centre" (the final one)
    zero_start  the last layer of the centre network starts at zero
    """

    skip: int
    eps: float
    empty_zero: bool
    first_centre_target: str
    zero_start: bool


VARIANTS = {
    "tf": Variant(skip=3, eps=1e-3, empty_zero=False, first_centre_target="truth", zero_start=False),
    "port": Variant(skip=2, eps=1e-5, empty_zero=True, first_centre_target="centre", zero_start=True),
}


@dataclass(frozen=True)
class FrustumOutput:
    """What the network says of B frustums of N points, everything rotated to the frustum's centre, metres.

    logits        (B, N, 2) background, object        mask  (B, N) bool, taken as object
    mean          (B, 3) mean of the masked points
    first_centre  (B, 3) of the centre network        box   (B, 59) raw numbers of the box network
    """

    logits: Tensor
    mask: Tensor
    mean: Tensor
    first_centre: Tensor
    box: Tensor

    @property
    def centre(self) -> Tensor:
        """(B, 3) geometric centre of the box."""
        return self.first_centre + self.box[:, :3]

    @property
    def heading_scores(self) -> Tensor:
        """(B, 12) logits of the heading bins."""
        return self.box[:, 3 : 3 + HEADING_BINS]

    @property
    def heading_units(self) -> Tensor:
        """(B, 12) residual of every bin in half bins."""
        return self.box[:, 3 + HEADING_BINS : 3 + 2 * HEADING_BINS]

    @property
    def heading_residuals(self) -> Tensor:
        """(B, 12) residual of every bin, radians."""
        return self.heading_units * (BIN / 2)

    @property
    def size_scores(self) -> Tensor:
        """(B, 8) logits of the size clusters."""
        first = 3 + 2 * HEADING_BINS
        return self.box[:, first : first + len(CLUSTERS)]

    @property
    def size_units(self) -> Tensor:
        """(B, 8, 3) residual of every cluster as a share of its mean length, width, height."""
        return self.box[:, 3 + 2 * HEADING_BINS + len(CLUSTERS) :].reshape(-1, len(CLUSTERS), 3)

    @property
    def size_residuals(self) -> Tensor:
        """(B, 8, 3) residual of every cluster, metres, l w h."""
        return self.size_units * torch.from_numpy(SIZE_TABLE).to(self.box)


def draw_object_points(
    mask: NDArray[np.bool_], rng: np.random.Generator, count: int = OBJECT_POINTS
) -> NDArray[np.int64]:
    """(B, count) indices of masked points in random order, (B, N) masks; zeros where a mask is empty.

    More than `count`: drawn without replacement; otherwise all of them and draws with replacement.
    """
    chosen = np.zeros((len(mask), count), np.int64)
    for row, own in zip(chosen, mask):
        places = np.flatnonzero(own)
        if len(places) > count:
            row[:] = rng.choice(places, count, replace=False)
        elif len(places):
            row[:] = rng.permutation(np.concatenate([places, rng.choice(places, count - len(places))]))
    return chosen


class _PointNet(nn.Module):
    """Numbered layers named `stem`1, `stem`2, ... with normalisations `norm`1, `norm`2, ..."""

    def add_layers(self, stem: str, norm: str, channels: Sequence[int], axes: int, eps: float) -> None:
        """Products with bias and their normalisations."""
        for number, (incoming, outgoing) in enumerate(pairwise(channels), start=1):
            self.add_module(f"{stem}{number}", _product(incoming, outgoing, axes))
            self.add_module(f"{norm}{number}", RowBatchNorm(outgoing, eps=eps))

    def layer(self, stem: str, norm: str, number: int, rows: Tensor) -> Tensor:
        """Product, normalisation, ReLU, (..., in) -> (..., out)."""
        product = cast(PointwiseWeight, self.get_submodule(f"{stem}{number}"))
        return project_relu(product, self.get_submodule(f"{norm}{number}"), rows)


def _product(incoming: int, outgoing: int, axes: int) -> PointwiseWeight:
    product = PointwiseWeight(incoming, outgoing, axes, bias=True)
    nn.init.xavier_uniform_(product.weight)
    return product


class Segmentation(_PointNet):
    """Which points of a frustum are the object's; 893,890 parameters with 4 input channels."""

    def __init__(self, channels: int, variant: Variant) -> None:
        super().__init__()
        self.skip = variant.skip
        self.add_layers("conv", "bn", (channels, 64, 64, 64, 128, 1024), 1, variant.eps)
        self.add_layers("dconv", "dbn", (64 + 1024 + len(CLASSES), 512, 256, 128, 128), 1, variant.eps)
        self.dconv5 = _product(128, 2, 1)

    def forward(self, points: Tensor, one_hot: Tensor) -> Tensor:
        """points (B, N, C), one_hot (B, 3) -> logits (B, N, 2)."""
        rows, skipped = points, points
        for number in range(1, 6):
            rows = self.layer("conv", "bn", number, rows)
            if number == self.skip:
                skipped = rows
        whole = torch.cat([maximum(rows), one_hot], dim=1)
        # The product of what all points share is taken once per frustum, not once per point.
        first = cast(PointwiseWeight, self.get_submodule("dconv1"))
        width = skipped.shape[-1]
        shared = F.linear(whole, first.matrix[:, width:], first.bias)
        rows = F.linear(skipped, first.matrix[:, :width]) + shared[:, None]
        rows = normalise_relu(self.get_submodule("dbn1"), rows)
        for number in range(2, 5):
            rows = self.layer("dconv", "dbn", number, rows)
        return cast(Tensor, self.dconv5(F.dropout(rows, 0.5, self.training)))


class Regression(_PointNet):
    """A PointNet that says some numbers of a set of points and its class: the centre network and the box network."""

    def __init__(self, widths: Sequence[int], hidden: Sequence[int], numbers: int, eps: float) -> None:
        super().__init__()
        self.widths = tuple(widths)
        self.add_layers("conv", "bn", (3, *widths), 1, eps)
        self.add_layers("fc", "fcbn", (widths[-1] + len(CLASSES), *hidden), 0, eps)
        self.fc3 = _product(hidden[-1], numbers, 0)

    def forward(self, xyz: Tensor, one_hot: Tensor) -> Tensor:
        """xyz (B, M, 3), one_hot (B, 3) -> (B, numbers)."""
        rows = xyz
        for number in range(1, len(self.widths) + 1):
            rows = self.layer("conv", "bn", number, rows)
        rows = torch.cat([maximum(rows), one_hot], dim=1)
        for number in (1, 2):
            rows = self.layer("fc", "fcbn", number, rows)
        return cast(Tensor, self.fc3(rows))


class FrustumPointNet(nn.Module):
    """Frustum PointNet v1; 1,641,472 parameters with 4 input channels.

    variant   "tf" (the original) or "port" (the common PyTorch port)
    channels  3 (x y z) or 4 (and the intensity)
    Raises SettingsError for another variant or number of channels.
    """

    def __init__(self, variant: str = "tf", channels: int = 4) -> None:
        super().__init__()
        if variant not in VARIANTS:
            raise SettingsError(f"variant: expected one of {', '.join(VARIANTS)}, got {variant!r}")
        if channels not in (3, 4):
            raise SettingsError(f"channels: expected 3 (x y z) or 4 (x y z intensity), got {channels}")
        self.variant, self.channels = variant, channels
        rules = VARIANTS[variant]
        self.InsSeg = Segmentation(channels, rules)
        self.STN = Regression((128, 128, 256), (256, 128), 3, rules.eps)
        self.est = Regression((128, 128, 256, 512), (512, 256), BOX_NUMBERS, rules.eps)
        if rules.zero_start:
            nn.init.zeros_(self.STN.fc3.weight)

    @property
    def rules(self) -> Variant:
        """What the variant means."""
        return VARIANTS[self.variant]

    def forward(
        self, points: Tensor, one_hot: Tensor, rng: np.random.Generator | None = None, chosen: Tensor | None = None
    ) -> FrustumOutput:
        """points (B, N, channels) rotated to the frustum's centre, one_hot (B, 3).

        rng     draws the object points (seed 0 without one); chosen  (B, 512) int64 their indices, drawn elsewhere
        """
        logits = self.InsSeg(points, one_hot)
        mask = logits[..., 1] > logits[..., 0]
        xyz, inside = points[..., :3], mask[..., None].to(points)
        mean = (xyz * inside).sum(dim=1) / inside.sum(dim=1).clamp(min=1)
        if chosen is None:
            drawn = draw_object_points(mask.cpu().numpy(), rng or np.random.default_rng(0))
            chosen = torch.from_numpy(drawn).to(points.device)
        objects = (xyz - mean[:, None]).gather(1, chosen[..., None].expand(-1, -1, 3))
        if self.rules.empty_zero:
            objects = objects * mask.any(dim=1)[:, None, None]
        delta = self.STN(objects, one_hot)
        box = self.est(objects - delta[:, None], one_hot)
        return FrustumOutput(logits, mask, mean, mean + delta, box)
