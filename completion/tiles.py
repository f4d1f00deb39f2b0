"""Depth Coefficients evaluated in tiles, as their authors did (Imran et al., CVPR 2019).

Their network was trained on crops of 352 x 420 and is run on three such tiles of a KITTI image, at columns 0, 420 and
822; where two overlap, their logits are summed before the softmax.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from completion.infer import NetworkCompleter
from completion.models import ModelSpec

TILE_WIDTH, TILE_ROWS = 420, 352


def tile_starts(width: int, tile_width: int) -> list[int]:
    """First columns of the tiles: side by side, the last one moved back to end with the image."""
    return [min(start, max(0, width - tile_width)) for start in range(0, width, tile_width)]


class TiledCompleter(NetworkCompleter):
    """A Depth Coefficients network on tiles of `tile_width` columns and the bottom `rows` rows.

    ValueError for a network with another output: only logits can be summed.
    """

    def __init__(
        self,
        model: nn.Module,
        spec: ModelSpec,
        device: str | torch.device = "cpu",
        decoding: str = "peak",
        rows: int | None = TILE_ROWS,
        tile_width: int = TILE_WIDTH,
    ) -> None:
        if spec.output != "coefficients":
            raise ValueError(
                f"tiles need a network with output 'coefficients', {spec.architecture} has {spec.output!r}"
            )
        if tile_width < 1:
            raise ValueError(f"tile_width: expected at least one column, got {tile_width}")
        super().__init__(model, spec, device, decoding, rows)
        self.tile_width = tile_width

    def _network_output(self, sparse: Tensor, rgb: Tensor) -> Tensor:
        summed = sparse.new_zeros(len(sparse), self.spec.bins.channels, *sparse.shape[-2:])
        for start in tile_starts(sparse.shape[-1], self.tile_width):
            columns = slice(start, start + self.tile_width)
            summed[..., columns] += super()._network_output(sparse[..., columns], rgb[..., columns])
        return summed
