"""NLSPN on one KITTI frame: its propagation and the whole network beside a plain torch composition.

    python -m benchmarks.nlspn --threads 2

The composition is what one writes without a compiled extension: a `grid_sample` per neighbour and iteration. The
network has random weights; its time does not depend on them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.nn import functional as F

from benchmarks.record import Measure, measure_of, save
from benchmarks.targets import EAGER
from benchmarks.timing import compare, format_table
from completion.cpu.propagation import kernel_operations, nlspn_forward
from completion.cpu.row_threads import RowThreads
from completion.models.deformable import cells, propagate, without_centre
from completion.models.nlspn import NLSPN, Operations

GATHER = "torch, one gather"


def grid_at(offset: Tensor, cell: tuple[int, int]) -> Tensor:
    """Sampling grid (B, H, W, 2) of `grid_sample` for p + cell + offset (B, 2, H, W)."""
    height, width = offset.shape[-2:]
    rows = torch.arange(height)[:, None] + cell[0] + offset[:, 0]
    columns = torch.arange(width) + cell[1] + offset[:, 1]
    return torch.stack((2 * columns / (width - 1) - 1, 2 * rows / (height - 1) - 1), -1)


def composed_confidence(affinities: Tensor, confidence: Tensor, offsets: Tensor) -> Tensor:
    """`deformable.times_confidence`, a `grid_sample` per neighbour."""
    grids = [grid_at(offsets[:, j], (0, 0)) for j in range(affinities.shape[1])]
    return affinities * torch.cat([F.grid_sample(confidence, grid, align_corners=True) for grid in grids], 1)


def composed_propagation(
    depth: Tensor, offsets: Tensor, weights: Tensor, iterations: int, kept: Tensor | None = None
) -> tuple[Tensor, ...]:
    """`deformable.propagate`, a `grid_sample` per neighbour and iteration; the last step alone."""
    middle, kernel = weights.shape[1] // 2, round(weights.shape[1] ** 0.5)
    around, moves, shares = cells(kernel), without_centre(offsets), without_centre(weights)
    del around[middle]
    grids = [grid_at(moves[:, j], cell) for j, cell in enumerate(around)]
    for _ in range(iterations):
        if kept is not None:
            depth = torch.where(kept > 0, kept, depth)
        total = weights[:, middle, None] * depth
        for j, grid in enumerate(grids):
            total = total + shares[:, j, None] * F.grid_sample(depth, grid, align_corners=True)
        depth = total
    return (depth,)


COMPOSED = Operations(composed_confidence, composed_propagation)


def frame(height: int, width: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Depth, offsets of about two pixels, weights of means, and measured depth at one pixel in twenty.

    With weights of both signs 18 iterations would amplify the last bit of a float.
    """
    generator = torch.Generator().manual_seed(0)
    depth = 5 + 60 * F.interpolate(torch.rand(1, 1, 8, 24, generator=generator), (height, width), mode="bilinear")
    offsets = 2 * torch.randn(1, 9, 2, height, width, generator=generator)
    offsets[:, 4] = 0
    affinities = torch.rand(1, 9, height, width, generator=generator)
    affinities[:, 4] = 0
    weights = affinities / affinities.sum(1, keepdim=True).clamp(min=1)
    weights[:, 4] = 1 - weights.sum(1)
    measured = torch.rand(1, 1, height, width, generator=generator) < 0.05
    return depth, offsets, weights.contiguous(), torch.where(measured, depth, 0.0)


def within_1_cm(a: Tensor, b: Tensor) -> bool:
    """In all but one pixel of a thousand: `grid_sample` normalises positions, and random weights amplify."""
    return float(torch.quantile((a - b).abs().flatten()[:: max(1, a.numel() // 100_000)], 0.999)) < 1e-2


def propagation_measure(size: tuple[int, int], repeats: int) -> Measure:
    """18 iterations on one map."""
    depth, offsets, weights, kept = frame(*size)
    ours = kernel_operations(RowThreads(torch.get_num_threads())).propagate

    def run(way: Callable[..., tuple[Tensor, ...]]) -> Tensor:
        return way(depth, offsets, weights, 18, kept)[-1]

    peers = {EAGER: partial(run, composed_propagation), GATHER: partial(run, propagate)}
    with torch.inference_mode():
        row = compare(
            f"NLSPN propagation, {size[0]}x{size[1]}, 18 iterations", partial(run, ours), peers, repeats, within_1_cm
        )
    print(format_table([row]), "\n")
    return measure_of(row)


def network_measure(width: int, size: tuple[int, int], repeats: int) -> Measure:
    """The whole network, ResNet-34 with `width` features."""
    torch.manual_seed(0)
    model = NLSPN(width=width).eval()
    torch.nn.init.normal_(model.prop_layer.conv_offset_aff.weight, std=0.02)
    last = model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    sparse, rgb = torch.rand(1, 1, *size), torch.rand(1, 3, *size)
    with torch.inference_mode():
        row = compare(
            f"NLSPN, ResNet-34, {width} features, {size[0]}x{size[1]}",
            partial(nlspn_forward(last), sparse, rgb),
            {EAGER: lambda: last.outputs(sparse, rgb, COMPOSED).depth, GATHER: partial(last, sparse, rgb)},
            repeats,
            within_1_cm,
        )
    print(format_table([row]), "\n")
    return measure_of(row)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="small sizes: whether it runs, not how fast")
    parser.add_argument("--json")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    width, size = (8, (96, 320)) if options.quick else (64, (352, 1216))
    measures = [propagation_measure(size, options.repeats), network_measure(width, size, options.repeats)]
    save(options.json, measures)


if __name__ == "__main__":
    main()
