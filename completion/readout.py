"""From a network's output to maps in metres, for every kind of output."""

from __future__ import annotations

from torch import Tensor

from completion.depth_coefficients import decode_logits
from completion.models import ModelSpec
from completion.twin_surface import READ_OUTS, fuse, split_head

Maps = tuple[Tensor, Tensor | None, Tensor | None, Tensor | None]


def default_read_out(spec: ModelSpec) -> str:
    """Return "fused" for two surfaces, "all" for Depth Coefficients, "depth" for one channel."""
    return {"twin": "fused", "coefficients": "all", "depth": "depth"}[spec.output]


def read_output(output: Tensor, spec: ModelSpec, read_out: str) -> Maps:
    """(B, C, h, w) full-resolution output -> depth, foreground, background, sigma, each (B, h, w) in metres, or None.

    read_out  two surfaces: one of `twin_surface.READ_OUTS`; Depth Coefficients: "all" or "peak" (three coefficients);
              one channel: "depth". ValueError when it does not fit the network's output.
    """
    allowed = {"twin": READ_OUTS, "coefficients": ("all", "peak"), "depth": ("depth",)}[spec.output]
    if read_out not in allowed:
        raise ValueError(
            f"read_out: a network with output {spec.output!r} offers {', '.join(allowed)}, got {read_out!r}"
        )
    if spec.output == "twin":
        foreground, background, sigma = split_head(output.float(), spec.depth_unit)
        return fuse(foreground, background, sigma, read_out), foreground, background, sigma
    if spec.output == "depth":
        return output[:, 0].float().clamp(min=0) * spec.depth_unit, None, None, None
    return decode_logits(output.float(), spec.bins, read_out), None, None, None
