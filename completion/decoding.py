"""From a network's output to maps in metres, for every kind of output."""

from __future__ import annotations

from torch import Tensor

from completion.depth_coefficients import decode_logits
from completion.mixture import expected_depth, twin_surfaces
from completion.models import ModelSpec
from completion.twin_surface import DECODINGS, fuse, split_head

# A mixture is read by its median, by its mean, or by its twin surfaces as TWISE is.
MIXTURE_DECODINGS = ("median", "expected", *DECODINGS)
DECODINGS_OF = {
    "twin": DECODINGS,
    "mixture": MIXTURE_DECODINGS,
    "coefficients": ("all", "peak"),
    "depth": ("depth",),
}

Maps = tuple[Tensor, Tensor | None, Tensor | None, Tensor | None]


def default_decoding(spec: ModelSpec) -> str:
    """Return "fused" for two surfaces, "all" for Depth Coefficients, "depth" for one channel, "median" of a mixture."""
    return {"mixture": "median", "twin": "fused", "coefficients": "all", "depth": "depth"}[spec.output]


def require_decoding(spec: ModelSpec, decoding: str) -> None:
    """ValueError when a network's output cannot be read this way."""
    allowed = DECODINGS_OF[spec.output]
    if decoding not in allowed:
        raise ValueError(
            f"decoding: a network with output {spec.output!r} offers {', '.join(allowed)}, got {decoding!r}"
        )


def decode_output(output: Tensor, spec: ModelSpec, decoding: str) -> Maps:
    """(B, C, h, w) full-resolution output -> depth, foreground, background, sigma, each (B, h, w) in metres, or None.

    decoding  two surfaces: one of `twin_surface.DECODINGS`; Depth Coefficients: "all" or "peak" (three coefficients);
              one channel: "depth"; mixture: one of MIXTURE_DECODINGS.
    Raises ValueError when it does not fit the network's output.
    """
    require_decoding(spec, decoding)
    if spec.output == "mixture":
        return _read_mixture(output.float(), decoding)
    if spec.output == "twin":
        foreground, background, sigma = split_head(output.float(), spec.depth_unit)
        return fuse(foreground, background, sigma, decoding), foreground, background, sigma
    if spec.output == "depth":
        return output[:, 0].float().clamp(min=0) * spec.depth_unit, None, None, None
    return decode_logits(output.float(), spec.bins, decoding), None, None, None


def _read_mixture(mixture: Tensor, decoding: str) -> Maps:
    foreground, background, sigma, median = (part[:, 0] for part in twin_surfaces(mixture))
    if decoding == "median":
        depth = median
    elif decoding == "expected":
        depth = expected_depth(mixture)[:, 0]
    else:
        depth = fuse(foreground, background, sigma, decoding)
    return depth, foreground, background, sigma
