"""The networks by name. Each entry says how its inputs are scaled and what comes out; see the builders themselves."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from torch import nn

from auglidar_base.errors import SettingsError
from completion.depth_coefficients import Bins
from completion.models.coefficients import CoefficientNetwork, CoefficientSparseToDense
from completion.models.enet import ENet
from completion.models.hourglass import MultiStack, Twise
from completion.models.nlspn import NLSPN
from completion.models.penet import PENet
from completion.models.ring_coefficients import RingCoefficients
from completion.models.selection import Selection
from completion.models.sparse_to_dense import SparseToDense, TwinSparseToDense

RGB_SCALINGS = ("unit", "standardised", "raw")
OUTPUTS = ("twin", "depth", "coefficients", "mixture")


@dataclass(frozen=True)
class ModelSpec:
    """Everything needed to rebuild a network and feed it.

    architecture  key of `MODELS`
    arguments     keyword arguments of its builder
    depth_unit    metres per unit of the network's depth, in and out (80 for TWISE)
    rgb           "unit": / 255; "standardised": ImageNet mean and deviation; "raw": 0..255
    output        "twin": foreground, background, sigma logit; "depth": one channel; "coefficients": logits per bin;
                  "mixture": a distribution over a few depths (`completion.mixture`)
    multiple_of   height and width must be multiples of this
    """

    architecture: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    depth_unit: float = 1.0
    rgb: str = "unit"
    output: str = "depth"
    multiple_of: int = 16

    def __post_init__(self) -> None:
        if self.architecture not in MODELS:
            raise SettingsError(f"architecture: expected one of {', '.join(sorted(MODELS))}, got {self.architecture!r}")
        if not isinstance(self.arguments, Mapping):
            raise SettingsError(f"arguments: expected names with values, got {self.arguments!r}")
        if self.rgb not in RGB_SCALINGS:
            raise SettingsError(f"rgb: expected one of {', '.join(RGB_SCALINGS)}, got {self.rgb!r}")
        if self.output not in OUTPUTS:
            raise SettingsError(f"output: expected one of {', '.join(OUTPUTS)}, got {self.output!r}")
        if not self.depth_unit > 0:
            raise SettingsError(f"depth_unit: expected metres > 0, got {self.depth_unit}")

    @property
    def bins(self) -> Bins:
        """Depth bins of a network with output "coefficients", from its builder's arguments."""
        given = {**getattr(MODELS[self.architecture].builder, "keywords", {}), **self.arguments}
        return Bins(**{name: given[name] for name in ("count", "size", "layout") if name in given})


@dataclass(frozen=True)
class Entry:
    """A builder and the inputs it was designed for."""

    builder: Callable[..., nn.Module]
    depth_unit: float
    rgb: str
    output: str
    multiple_of: int


MODELS: dict[str, Entry] = {
    "twise": Entry(Twise, 80.0, "unit", "twin", 16),
    "msg_chn": Entry(MultiStack, 1.0, "unit", "depth", 16),
    "sparse_to_dense": Entry(SparseToDense, 1.0, "raw", "depth", 16),
    "twise_resnet": Entry(TwinSparseToDense, 80.0, "unit", "twin", 16),
    "depth_coefficients": Entry(CoefficientNetwork, 1.0, "unit", "coefficients", 16),
    # As thesis Fig. 3.7 draws it: ResNet-34, 80 channels in and out. The published code has 18 layers and 82.
    "depth_coefficients_34": Entry(
        partial(CoefficientNetwork, layers=34, layout="compact"), 1.0, "unit", "coefficients", 16
    ),
    # The 2x2 of thesis Table 3.3: sparse depth or coefficients in, metres or coefficients out, on one backbone.
    "resnet_depth_to_depth": Entry(
        partial(CoefficientSparseToDense, coefficient_input=False, coefficient_head=False), 1.0, "unit", "depth", 16
    ),
    "resnet_dc_to_depth": Entry(partial(CoefficientSparseToDense, coefficient_head=False), 1.0, "unit", "depth", 16),
    "resnet_depth_to_dc": Entry(
        partial(CoefficientSparseToDense, coefficient_input=False), 1.0, "unit", "coefficients", 16
    ),
    "resnet_dc_to_dc": Entry(CoefficientSparseToDense, 1.0, "unit", "coefficients", 16),
    "ring_coefficients": Entry(RingCoefficients, 1.0, "standardised", "coefficients", 32),
    "enet": Entry(ENet, 1.0, "raw", "depth", 32),
    "penet": Entry(PENet, 1.0, "raw", "depth", 32),
    "nlspn": Entry(NLSPN, 1.0, "standardised", "depth", 1),
    "selection": Entry(Selection, 1.0, "standardised", "mixture", 32),
}


def default_spec(architecture: str, **arguments: Any) -> ModelSpec:
    """The published input scaling of `architecture` with these builder arguments. ValueError for an unknown name."""
    if architecture not in MODELS:
        raise SettingsError(f"architecture: expected one of {', '.join(sorted(MODELS))}, got {architecture!r}")
    entry = MODELS[architecture]
    return ModelSpec(architecture, arguments, entry.depth_unit, entry.rgb, entry.output, entry.multiple_of)


def with_rgb(spec: ModelSpec, rgb: str) -> ModelSpec:
    """The same network fed with another colour scaling."""
    return replace(spec, rgb=rgb)


def build_model(spec: ModelSpec) -> nn.Module:
    """A freshly initialised network (torch's global generator). ValueError for arguments its builder does not take."""
    try:
        return MODELS[spec.architecture].builder(**spec.arguments)
    except TypeError as error:
        raise SettingsError(f"{spec.architecture}: cannot be built with {dict(spec.arguments)}: {error}") from error
