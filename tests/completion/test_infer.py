"""Completion of any frame: sizes, crops, batches, monocular frames, read-outs, names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from completion.checkpoints import Card, CheckpointError, save_checkpoint
from completion.decoding import decode_output
from completion.infer import NetworkCompleter, load_completer, network_completer
from completion.models import build_model, default_spec
from completion.models.classical import ClassicalCompleter, linear_inverse_depth, morphological, nearest_depth
from completion.twin_surface import DECODINGS, fuse
from tests.completion.scenes import street

SMALL = {
    "twise": {"channels": 4},
    "msg_chn": {"channels": 4},
    "selection": {"width": 8},
    "twise_resnet": {},
    "depth_coefficients": {"count": 8, "size": 10.0},
}


def completer(architecture: str, rows: int | None = None) -> NetworkCompleter:
    torch.manual_seed(0)
    spec = default_spec(architecture, **SMALL[architecture])
    decoding = {"depth": "depth", "coefficients": "peak", "twin": "fused", "mixture": "median"}[spec.output]
    return network_completer(build_model(spec), spec, decoding=decoding, rows=rows)


@pytest.mark.parametrize("architecture", sorted(SMALL))
@pytest.mark.parametrize("size", [(50, 70), (64, 64), (33, 129)])
def test_any_size(architecture: str, size: tuple[int, int]) -> None:
    frame = street(1, *size)
    found = completer(architecture).complete(frame.sparse, frame.image)
    assert found.size == size
    assert found.has_surfaces == (architecture in ("twise", "selection", "twise_resnet"))


@pytest.mark.parametrize("architecture", sorted(SMALL))
def test_monocular(architecture: str) -> None:
    frame = street(2, 48, 64)
    found = completer(architecture).complete(np.zeros_like(frame.sparse), frame.image)
    assert np.isfinite(found.depth).all()


def test_padding_is_at_the_top_and_right() -> None:
    """A frame of fitting size inside a larger, empty one: its bottom left corner completes alike."""
    frame = street(3, 64, 64)
    spec = default_spec("twise", **SMALL["twise"])
    model = build_model(spec)
    found = network_completer(model, spec)
    sparse = torch.zeros(1, 1, 64, 64)
    rgb = torch.zeros(1, 3, 64, 64)
    seen: dict[str, tuple[torch.Tensor, ...]] = {}
    model.register_forward_hook(lambda _m, given, _o: seen.update(given=given))
    found.complete(frame.sparse[3:, :60], frame.image[3:, :60])
    sparse[0, 0, 3:, :60] = torch.from_numpy(frame.sparse[3:, :60]) / spec.depth_unit
    assert torch.equal(seen["given"][0], sparse)
    assert seen["given"][1].shape == rgb.shape
    expected = torch.from_numpy(frame.image[3:, :60]).permute(2, 0, 1) / 255
    torch.testing.assert_close(seen["given"][1][0, :, 3:, :60], expected)


def test_bottom_rows_only() -> None:
    frame = street(4, 64, 64)
    found = completer("twise", rows=32).complete(frame.sparse, frame.image)
    assert found.depth[:32].max() == 0
    assert found.foreground is not None
    assert found.foreground[:32].max() == 0
    alone = completer("twise").complete(frame.sparse[32:], frame.image[32:])
    np.testing.assert_allclose(found.depth[32:], alone.depth, rtol=1e-5, atol=1e-5)


def test_loading_by_path(tmp_path: Path) -> None:
    spec = default_spec("selection", width=8)
    model = build_model(spec)
    path = save_checkpoint(tmp_path / "net", model, Card(spec, "hard"))
    frame = street(6, 64, 96)
    found = load_completer(str(path)).complete(frame.sparse, frame.image)
    expected = network_completer(model, spec, decoding="hard").complete(frame.sparse, frame.image)
    np.testing.assert_array_equal(found.depth, expected.depth)
    assert found.sigma is not None
    assert found.foreground is not None
    assert found.background is not None
    chosen = np.where(found.sigma > 0.5, found.foreground, found.background)
    np.testing.assert_array_equal(found.depth, chosen)


def test_names() -> None:
    assert isinstance(load_completer("classical"), ClassicalCompleter)
    with pytest.raises(CheckpointError, match="no such weights"):
        load_completer("absent")
    with pytest.raises(ValueError, match="backend"):
        load_completer("classical", backend="tpu")


def test_decodings_by_hand() -> None:
    near, far, sigma = np.array([2.0, 2.0]), np.array([10.0, 10.0]), np.array([0.75, 0.25])
    expected = {"fused": [4, 8], "foreground": [2, 2], "background": [10, 10], "mean": [6, 6], "hard": [2, 10]}
    assert set(expected) == set(DECODINGS)
    for name, values in expected.items():
        assert fuse(near, far, sigma, name).tolist() == values
        tensors = [torch.from_numpy(x) for x in (near, far, sigma)]
        assert fuse(*tensors, name).tolist() == values
    with pytest.raises(ValueError, match="decoding"):
        fuse(near, far, sigma, "best")


def test_surfaces_are_rectified_before_mixing() -> None:
    output = torch.tensor([-0.5, 0.25, 0.0]).view(1, 3, 1, 1)
    depth, foreground, _, _ = decode_output(output, default_spec("twise"), "fused")
    assert foreground is not None
    assert (float(foreground), float(depth)) == (0.0, 10.0)


def test_decoding_must_fit_the_network() -> None:
    with pytest.raises(ValueError, match="offers"):
        decode_output(torch.zeros(1, 1, 2, 2), default_spec("msg_chn"), "hard")


def plane(height: int = 40, width: int = 60) -> tuple[np.ndarray, np.ndarray]:
    inverse = 0.02 + np.mgrid[:height, :width][0] * 0.002 + np.mgrid[:height, :width][1] * 0.0005
    dense = (1 / inverse).astype(np.float32)
    sparse = np.zeros_like(dense)
    sparse[::6, ::3] = dense[::6, ::3]
    return dense, sparse


def test_linear_in_inverse_depth_is_exact_on_a_plane() -> None:
    dense, sparse = plane()
    inside = (slice(0, 37), slice(0, 58))
    np.testing.assert_allclose(linear_inverse_depth(sparse)[inside], dense[inside], rtol=1e-4)


def test_nearest_takes_the_nearest() -> None:
    sparse = np.zeros((5, 9), np.float32)
    sparse[2, 1], sparse[2, 7] = 5.0, 9.0
    filled = nearest_depth(sparse)
    assert (filled[:, :4] == 5).all()  # column 4 is as far from both: either will do
    assert (filled[:, 5:] == 9).all()


def test_morphological_fills_and_copies() -> None:
    dense, sparse = plane()
    found = morphological(sparse)
    assert found.min() > 0
    assert np.median(np.abs(found - dense) / dense) < 0.15


@pytest.mark.parametrize("method", ["linear", "nearest", "morphological"])
@pytest.mark.parametrize("samples", [0, 1, 2, 5])
def test_classical_methods_survive_few_samples(method: str, samples: int) -> None:
    sparse = np.zeros((20, 30), np.float32)
    sparse[10, 3 : 3 + samples] = 7.0  # on one line
    found = ClassicalCompleter(method).complete(sparse, np.zeros((20, 30, 3), np.uint8))
    assert found.depth.tolist() == np.full((20, 30), 7.0 if samples else 0.0).tolist()


def test_the_network_of_figure_3_7_has_34_layers_and_80_channels() -> None:
    spec = default_spec("depth_coefficients_34")
    with torch.device("meta"):
        state = build_model(spec).state_dict()
    assert state["depth_input.weight"].shape[1] == state["head.weight"].shape[0] == spec.bins.channels == 80
    blocks = [len({name.split(".")[1] for name in state if name.startswith(f"encoder{n}.")}) for n in (1, 2, 3, 4)]
    assert blocks == [3, 4, 6, 3]
    assert default_spec("depth_coefficients").bins.channels == 82
