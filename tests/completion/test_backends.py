"""Exports: equal to torch at sizes they were not traced at, kept under their weights' hash, refused with a reason."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from completion import backends
from completion.checkpoints import Card, save_checkpoint
from completion.decoding import default_decoding
from completion.infer import NetworkCompleter, load_completer
from completion.models import build_model, default_spec
from tests.completion.scenes import street

SMALL = {"selection": {"width": 8}, "twise": {"channels": 8}, "msg_chn": {"channels": 4}}
OWN = {**SMALL, "ring_coefficients": {"width": 8}, "nlspn": {"layers": 18, "width": 8}}
NEEDS = {"numba": (), "onnxruntime": ("onnx", "onnxruntime"), "openvino": ("onnx", "openvino")}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "auglidar"


def saved(folder: Path, architecture: str, seed: int = 0) -> Path:
    torch.manual_seed(seed)
    spec = default_spec(architecture, **OWN[architecture])
    model = build_model(spec)
    if architecture == "selection":
        torch.nn.init.normal_(model.network.head.weight, std=0.3)
    if architecture == "nlspn":
        torch.nn.init.normal_(model.prop_layer.conv_offset_aff.weight, std=0.3)
    return save_checkpoint(folder / f"{architecture}{seed}", model, Card(spec, default_decoding(spec)))


@pytest.mark.parametrize(
    ("architecture", "backend"), [*((name, backend) for name in sorted(SMALL) for backend in NEEDS), ("nlspn", "numba")]
)
def test_equal_to_torch_within_a_millimetre(tmp_path: Path, architecture: str, backend: str) -> None:
    for package in NEEDS[backend]:
        pytest.importorskip(package)
    path = saved(tmp_path, architecture)
    there, here = load_completer(path, backend=backend), load_completer(path)
    for size in ((75, 130), (64, 64)):
        frame = street(1, *size)
        found, expected = (one.complete(frame.sparse, frame.image) for one in (there, here))
        assert np.abs(found.depth - expected.depth).max() < 1e-3
        assert found.has_surfaces == expected.has_surfaces


def test_exports_are_kept_by_their_weights(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("onnxruntime")
    first, second = saved(tmp_path, "twise", 0), saved(tmp_path, "twise", 1)
    load_completer(first, backend="onnxruntime")
    load_completer(second, backend="onnxruntime")
    assert len(list(cache.glob("twise-*.onnx"))) == 2

    def export_again(_model: torch.nn.Module) -> bytes:
        raise AssertionError("exported twice")

    monkeypatch.setattr(backends, "export_onnx", export_again)
    load_completer(first, backend="onnxruntime")


def test_a_cache_that_cannot_be_written_is_no_obstacle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("onnxruntime")
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.warns(RuntimeWarning, match="not kept"):
        found = load_completer(saved(tmp_path, "twise"), backend="onnxruntime")
    frame = street(1, 64, 64)
    assert found.complete(frame.sparse, frame.image).size == (64, 64)


@pytest.mark.parametrize("architecture", sorted(OWN))
def test_auto_needs_no_further_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, architecture: str) -> None:
    monkeypatch.setattr(backends, "find_spec", lambda name: None)
    found = load_completer(saved(tmp_path, architecture), backend="auto")
    assert isinstance(found, NetworkCompleter)
    own = load_completer(saved(tmp_path, architecture), backend="numba")
    assert isinstance(own, NetworkCompleter)
    assert type(found.executor) is type(own.executor)
    frame = street(1, 64, 64)
    depths = [one.complete(frame.sparse, frame.image).depth for one in (found, own)]
    np.testing.assert_array_equal(*depths)


def test_auto_leaves_other_networks_to_torch(tmp_path: Path) -> None:
    spec = default_spec("depth_coefficients", count=8, size=10.0)
    path = save_checkpoint(tmp_path / "dc", build_model(spec), Card(spec, "all"))
    frame = street(1, 64, 64)
    found, plain = (
        load_completer(path, backend=name).complete(frame.sparse, frame.image) for name in ("auto", "torch")
    )
    np.testing.assert_array_equal(found.depth, plain.depth)
    with pytest.raises(ValueError, match="depth_coefficients on cpu; use backend 'torch'"):
        load_completer(path, backend="onnxruntime")


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_missing_packages_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, backend: str) -> None:
    path = saved(tmp_path, "twise")
    real = importlib.util.find_spec
    monkeypatch.setattr(backends, "find_spec", lambda name: None if name == backend else real(name) or object())
    with pytest.raises(ImportError, match=rf"needs {backend}: pip install 'auglidar\["):
        load_completer(path, backend=backend)


# Published variants with the same tensors: nothing but the card tells them apart.
TWINS = {
    "twise": ({"channels": 4, "pooling": "avg"}, {"channels": 4, "pooling": "max"}),
    "msg_chn": ({"channels": 4, "extra_skips": True}, {"channels": 4, "extra_skips": False}),
}


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
@pytest.mark.parametrize("architecture", sorted(TWINS))
def test_variants_with_the_same_weights_are_exported_apart(tmp_path: Path, architecture: str, backend: str) -> None:
    for package in NEEDS[backend]:
        pytest.importorskip(package)
    frame, depths = street(1, 64, 96, row_step=3), []
    weights = {}
    for number, arguments in enumerate(TWINS[architecture]):
        spec = default_spec(architecture, **arguments)
        model = build_model(spec)
        weights = weights or {name: value.clone() for name, value in model.state_dict().items()}
        model.load_state_dict(weights)
        path = save_checkpoint(tmp_path / f"variant{number}", model, Card(spec, default_decoding(spec)))
        found = load_completer(path, backend=backend).complete(frame.sparse, frame.image).depth
        assert np.abs(found - load_completer(path).complete(frame.sparse, frame.image).depth).max() < 1e-3
        depths.append(found)
    assert np.abs(depths[0] - depths[1]).max() > 2e-3


@pytest.mark.parametrize("package", ["torch", "onnx", "onnxruntime", "openvino"])
def test_another_exporter_exports_anew(monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    card = Card(default_spec("twise"), "fused", sha256="0" * 64)
    before, real = backends.export_key(card), backends.version
    monkeypatch.setattr(backends, "version", lambda name: "99.0" if name == package else real(name))
    assert backends.export_key(card) != before


def test_everything_of_a_card_that_shapes_the_graph_is_in_the_key() -> None:
    spec = default_spec("twise")
    cards = (
        Card(spec, "fused", sha256="a"),
        Card(spec, "mean", sha256="a"),
        Card(spec, "fused", sha256="b"),
        Card(default_spec("twise", pooling="max"), "fused", sha256="a"),
        Card(default_spec("msg_chn"), "fused", sha256="a"),
    )
    assert len({backends.export_key(card) for card in cards}) == len(cards)
    assert backends.export_key(Card(spec, "fused", {"seed": 1}, "a")) == backends.export_key(cards[0])
