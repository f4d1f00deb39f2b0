"""From a network's output to maps in metres, for every kind of output."""

from __future__ import annotations

from torch import Tensor

from completion.depth_coefficients import decode_logits
from completion.mixture import expected_depth, twin_surfaces
from completion.models import ModelSpec
from completion.twin_surface import READ_OUTS, fuse, split_head

# A mixture is read by its median, by its mean, or by its twin surfaces as TWISE is.
MIXTURE_READ_OUTS = ("median", "expected", *READ_OUTS)
READ_OUTS_OF = {
    "twin": READ_OUTS,
    "mixture": MIXTURE_READ_OUTS,
    "coefficients": ("all", "peak"),
    "depth": ("depth",),
}

Maps = tuple[Tensor, Tensor | None, Tensor | None, Tensor | None]


def default_read_out(spec: ModelSpec) -> str:
    """Return "fused" for two surfaces, "all" for Depth Coefficients, "depth" for one channel, "median" of a mixture."""
    return {"mixture": "median", "twin": "fused", "coefficients": "all", "depth": "depth"}[spec.output]


def require_read_out(spec: ModelSpec, read_out: str) -> None:
    """ValueError when a network's output cannot be read this way."""
    allowed = READ_OUTS_OF[spec.output]
    if read_out not in allowed:
        raise ValueError(
            f"read_out: a network with output {spec.output!r} offers {', '.join(allowed)}, got {read_out!r}"
        )


def read_output(output: Tensor, spec: ModelSpec, read_out: str) -> Maps:
    """(B, C, h, w) full-resolution output -> depth, foreground, background, sigma, each (B, h, w) in metres, or None.

    read_out  two surfaces: one of `twin_surface.READ_OUTS`; Depth Coefficients: "all" or "peak" (three coefficients);
              one channel: "depth"; mixture: one of MIXTURE_READ_OUTS.
    Raises ValueError when it does not fit the network's output.
    """
    require_read_out(spec, read_out)
    if spec.output == "mixture":
        return _read_mixture(output.float(), read_out)
    if spec.output == "twin":
        foreground, background, sigma = split_head(output.float(), spec.depth_unit)
        return fuse(foreground, background, sigma, read_out), foreground, background, sigma
    if spec.output == "depth":
        return output[:, 0].float().clamp(min=0) * spec.depth_unit, None, None, None
    return decode_logits(output.float(), spec.bins, read_out), None, None, None


def _read_mixture(mixture: Tensor, read_out: str) -> Maps:
    foreground, background, sigma, median = (part[:, 0] for part in twin_surfaces(mixture))
    if read_out == "median":
        depth = median
    elif read_out == "expected":
        depth = expected_depth(mixture)[:, 0]
    else:
        depth = fuse(foreground, background, sigma, read_out)
    return depth, foreground, background, sigma
