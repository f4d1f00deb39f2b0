"""Depth Coefficients evaluated in tiles, as their authors did (Imran et al., CVPR 2019).

Their network was trained on crops of 352 x 420 and is run on three such tiles of a KITTI image, at columns 0, 420 and
822; where two overlap, their logits are summed before the softmax.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from completion.executors import NetworkExecutor, finest_of
from completion.infer import NetworkCompleter
from completion.models import ModelSpec

TILE_WIDTH, TILE_ROWS = 420, 352


def tile_starts(width: int, tile_width: int) -> list[int]:
    """First columns of the tiles: side by side, the last one moved back to end with the image."""
    return [min(start, max(0, width - tile_width)) for start in range(0, width, tile_width)]


class TiledExecutor(NetworkExecutor):
    """A Depth Coefficients network on tiles of `tile_width` columns.

    ValueError for a network with another output: only logits can be summed.
    """

    def __init__(self, model: nn.Module, spec: ModelSpec, decoding: str, device: str, tile_width: int) -> None:
        if spec.output != "coefficients":
            raise ValueError(
                f"tiles need a network with output 'coefficients', {spec.architecture} has {spec.output!r}"
            )
        if tile_width < 1:
            raise ValueError(f"tile_width: expected at least one column, got {tile_width}")
        on_device = model.to(device=torch.device(device), memory_format=torch.channels_last)  # type: ignore[call-overload]
        super().__init__(finest_of(on_device.eval()), spec, decoding, device)
        self.tile_width = tile_width

    def output(self, sparse: Tensor, rgb: Tensor) -> Tensor:
        """See `NetworkExecutor.output`: the sum of the tiles'."""
        summed = sparse.new_zeros(len(sparse), self.spec.bins.channels, *sparse.shape[-2:])
        for start in tile_starts(sparse.shape[-1], self.tile_width):
            columns = slice(start, start + self.tile_width)
            summed[..., columns] += super().output(sparse[..., columns], rgb[..., columns])
        return summed


def tiled_completer(
    model: nn.Module,
    spec: ModelSpec,
    device: str = "cpu",
    decoding: str = "peak",
    rows: int | None = TILE_ROWS,
    tile_width: int = TILE_WIDTH,
) -> NetworkCompleter:
    """The completer of `TiledExecutor` on the bottom `rows` rows; ValueError as there."""
    return NetworkCompleter(TiledExecutor(model, spec, decoding, device, tile_width), rows)
