"""Depth Coefficients in tiles: where they lie, what is summed, and for which networks."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from completion.depth_coefficients import decode_logits
from completion.infer import network_completer
from completion.models import ModelSpec, build_model, default_spec
from completion.tiles import tile_starts, tiled_completer
from tests.completion.scenes import street


@pytest.fixture
def network() -> tuple[torch.nn.Module, ModelSpec]:
    torch.manual_seed(0)
    spec = default_spec("depth_coefficients", count=8, size=10.0)
    return build_model(spec).eval(), spec


def test_published_tiles() -> None:
    assert tile_starts(1242, 420) == [0, 420, 822]
    assert tile_starts(840, 420) == [0, 420]
    assert tile_starts(300, 420) == [0]


def test_logits_are_summed_where_tiles_overlap(network: tuple[torch.nn.Module, ModelSpec]) -> None:
    """Width 80 in tiles of 48: columns 0..47 and 32..79; 32..47 belong to both."""
    model, spec = network
    frame = street(1, 32, 80)
    found = tiled_completer(model, spec, rows=None, decoding="all", tile_width=48).complete(frame.sparse, frame.image)
    sparse = torch.from_numpy(frame.sparse)[None, None]
    rgb = torch.from_numpy(frame.image).permute(2, 0, 1)[None].float() / 255
    with torch.inference_mode():
        left, right = (model(sparse[..., a:b], rgb[..., a:b])[0] for a, b in ((0, 48), (32, 80)))
    logits = torch.cat((left[..., :32], left[..., 32:] + right[..., :16], right[..., 16:]), -1)
    np.testing.assert_allclose(found.depth, decode_logits(logits, spec.bins, "all")[0].numpy(), rtol=1e-4)


def test_one_wide_tile_is_the_whole_image(network: tuple[torch.nn.Module, ModelSpec]) -> None:
    frame = street(2, 40, 60)
    tiled = tiled_completer(*network, rows=32, tile_width=60).complete(frame.sparse, frame.image)
    whole = network_completer(*network, decoding="peak", rows=32).complete(frame.sparse, frame.image)
    np.testing.assert_array_equal(tiled.depth, whole.depth)
    assert tiled.depth[:8].max() == 0


def test_other_networks_are_refused(network: tuple[torch.nn.Module, ModelSpec]) -> None:
    spec = default_spec("twise", channels=4)
    with pytest.raises(ValueError, match="output 'coefficients', twise has 'twin'"):
        tiled_completer(build_model(spec), spec)
    with pytest.raises(ValueError, match="tile_width"):
        tiled_completer(*network, tile_width=0)
