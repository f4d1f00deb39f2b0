"""What a published file of NLSPN does not say, asked for.

Its tensors tell the ResNet, the kernel and whether there is a confidence; the switches of the propagation change the
result but no tensor, and the authors' code has had two behaviours (see `models.nlspn.NonLocalPropagation`).
"""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from auglidar_base.errors import CheckpointError, SettingsError
from completion.models import ModelSpec, default_spec
from completion.models.nlspn import AFFINITIES, WIDTH

SWITCHES = ("legacy", "preserve_input")
CHOICES = (*SWITCHES, "affinity", "iterations")
ITERATIONS = 18
ASK = (
    "nothing in a file of NLSPN tells how it was trained, and a wrong choice gives visibly worse depth; choose "
    "legacy=true and preserve_input=true for the authors' released weights, legacy=false for a training with their "
    "present code, preserve_input as in its command"
)


def nlspn_spec(tensors: Mapping[str, Tensor], choices: Mapping[str, object]) -> ModelSpec:
    """The network of a file.

    choices  legacy and preserve_input must be given; affinity is one of AFFINITIES (default: what the stored scale
             fits: TC where it is exactly K^2 - 1, else TGASS; 1 leaves AS and ASS, so it has to be given), iterations
             by default 18

    SettingsError when a choice is missing or is none, CheckpointError when the file contradicts it.
    """
    unknown, missing = sorted(set(choices) - set(CHOICES)), [name for name in SWITCHES if name not in choices]
    if unknown:
        raise SettingsError(f"nlspn: expected choices among {', '.join(CHOICES)}, got {', '.join(unknown)}")
    if missing:
        raise SettingsError(f"nlspn: {' and '.join(missing)} not given: {ASK}")
    for name in SWITCHES:
        if not isinstance(choices[name], bool):
            raise SettingsError(f"nlspn: {name}: expected true or false, got {choices[name]!r}")
    iterations = choices.get("iterations", ITERATIONS)
    if not isinstance(iterations, int) or iterations < 1:
        raise SettingsError(f"nlspn: iterations: expected a whole number >= 1, got {iterations!r}")
    kernel = _kernel(tensors)
    return default_spec(
        "nlspn",
        layers=34 if "conv2.2.conv1.weight" in tensors else 18,
        width=_width(tensors),
        kernel=kernel,
        affinity=_affinity(tensors, kernel, choices.get("affinity")),
        iterations=iterations,
        confidence=any(name.startswith("cf_dec") for name in tensors),
        legacy=choices["legacy"],
        preserve_input=choices["preserve_input"],
    )


def _kernel(tensors: Mapping[str, Tensor]) -> int:
    ones = tensors.get("prop_layer.w")
    fits = ones is not None and ones.ndim == 4 and ones.shape[-1] >= 3 and ones.shape[-1] % 2 == 1
    return int(ones.shape[-1]) if fits and ones is not None else 3


def _width(tensors: Mapping[str, Tensor]) -> int:
    first = tensors.get("conv1_dep.0.weight")
    return WIDTH if first is None or first.ndim != 4 or not first.shape[0] else 4 * int(first.shape[0])


def _affinity(tensors: Mapping[str, Tensor], kernel: int, chosen: object) -> str:
    """The chosen normalisation, or the only one that the stored scale leaves."""
    if chosen is not None and chosen not in AFFINITIES:
        raise SettingsError(f"nlspn: affinity: expected one of {', '.join(AFFINITIES)}, got {chosen!r}")
    stored = tensors.get("prop_layer.aff_scale_const")
    scale = float(stored) if stored is not None and stored.numel() == 1 else None
    fixed = {"AS": 1.0, "ASS": 1.0, "TC": float(kernel**2 - 1)}
    if isinstance(chosen, str):
        if scale is not None and fixed.get(chosen, scale) != scale:
            raise CheckpointError(
                f"affinity {chosen} has the scale {fixed[chosen]:g}, the file stores {scale:g}: choose another affinity"
            )
        return chosen
    if scale == 1:
        raise SettingsError(
            "nlspn: affinity not given: the file stores the scale 1 of AS and of ASS; choose affinity=AS or ASS"
        )
    return "TC" if scale == fixed["TC"] else "TGASS"
